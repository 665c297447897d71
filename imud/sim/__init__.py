"""Simulated devices with known truth: `imud demo` and the tests run the same ones."""
