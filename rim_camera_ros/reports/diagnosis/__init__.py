"""The page of a diagnosis: the missing physics, the evidence, and the pictures."""
