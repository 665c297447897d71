"""Watches over the samples of one device: what they contradict, and what the device says of itself."""
