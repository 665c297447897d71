"""Services of the host: clocks, files, log, threads, event loop, service manager."""
