"""The command `egosim`, one file for each subcommand; what is heavy is imported when it runs."""
