"""The page of a diagnosis: what was left out, the proof, and the pictures."""
