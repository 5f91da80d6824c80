"""The verbs of the supervision server, one module each: its docstring is the help, `VERBS` are its own verbs."""
