"""The chain of effects: applied in `simulate`, undone by tables in `correct`."""
