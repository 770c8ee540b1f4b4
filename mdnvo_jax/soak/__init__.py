"""Trials of survival, for hours if need be: what `bin/soak` runs. Each part runs in a process of its own."""
