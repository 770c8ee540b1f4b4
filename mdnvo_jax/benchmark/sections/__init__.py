"""One module a section; each has `measure(settings) -> Outcome`."""
