"""What a simulated sensor measures: motion, mounting, noise."""
