"""Coverage of a recording: parameters that its stations determine so far, and the station that adds most."""
