"""The command `egosim`: options, their help, and printed results; one file for each subcommand.

Commands check their options and call the other packages, which hold the work itself. Heavy modules
are imported inside `run`, which keeps `egosim --help` fast.

`main` in `__main__` prints a first line and imports `commands`, which runs the command.
`comparison` has the options that `evaluate` and `table` share.
"""
