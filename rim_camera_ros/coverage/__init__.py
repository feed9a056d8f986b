"""What recorded stations determine so far, and which station would add the most."""
