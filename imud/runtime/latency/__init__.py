"""Latency: how long samples of a device may wait to be processed together, who asks for it, and the wait itself."""
