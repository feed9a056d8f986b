"""What all nodes share: parameters, lifecycle, quality of service, diagnostics, messages, the executor."""
