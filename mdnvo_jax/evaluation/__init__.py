"""How far estimates are from the truth, and whether their sigmas say so."""
