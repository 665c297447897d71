"""The life of a device: link, codec and clock from start to end, and again after each loss of the link."""
