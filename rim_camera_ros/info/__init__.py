"""Contents of a recording, a camera file or a scene file: facts for programs, text for people."""
