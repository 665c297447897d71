"""`make chaos`: a daemon on the kernel's buses, random faults of all kinds, and the check of the ledgers."""
