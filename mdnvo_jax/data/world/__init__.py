"""The parts of a procedural drive: road, motion, things beside the road, and the ray caster that sees them."""
