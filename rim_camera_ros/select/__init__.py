"""Which effects recordings ask for: candidates, the evidence of held-out poses, null replicates, search.

docs/decision.md says how it decides, and with which numbers.
"""
