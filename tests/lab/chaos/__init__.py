"""`make chaos`: a daemon on the kernel's buses, random faults of all kinds together, and the account afterwards."""
