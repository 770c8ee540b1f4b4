"""`bin/benchmark`: how fast this package is on this machine, beside what a user would pick instead."""
