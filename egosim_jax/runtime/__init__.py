"""What every command shares: parsing, exit codes, interrupts, progress and worker processes."""
