"""Selection of effects: candidates, the evidence of held-out poses, null replicates, and the search.

docs/decision.md states the rules of decision and their numbers.
"""
