"""The life of a device: its link, its codec and its clock, from start to end, and again after each loss of the link."""
