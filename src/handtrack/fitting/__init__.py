"""The fit of one frame: terms, batched Gauss-Newton, workspaces."""
