"""The commands of ``rim``, a module each: ``add_parser`` describes one, its ``run`` does it."""
