"""Physics of a simulated sensor: motion, mounting, noise."""
