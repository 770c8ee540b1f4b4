"""From files, or a rendered world, to batches of windows."""
