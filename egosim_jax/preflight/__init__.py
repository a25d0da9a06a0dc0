"""Whether a program fits a machine, and how fast it can be there, told without the machine."""
