"""The chain of effects at work: forward in `simulate`, backward and folded into tables in `correct`."""
