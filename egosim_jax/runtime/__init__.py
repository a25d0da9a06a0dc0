"""Services of every command's process; nothing here knows models, scenes or files.

command      parsing, error messages and exit codes
interrupts   Ctrl-C during imports and afterwards
preemption   SIGTERM during imports and afterwards
progress     live or plain progress on stderr
options      names of the options that a user types, for messages
processes    functions run in worker processes
"""
