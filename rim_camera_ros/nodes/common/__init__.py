"""Parts common to all nodes: parameters, lifecycle, quality of service, diagnostics, messages, executor."""
