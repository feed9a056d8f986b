"""The blind benchmark of the diagnosis: recordings whose left-out physics nobody who tunes it has seen."""
