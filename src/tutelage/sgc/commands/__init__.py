"""The verbs of connectivity, one module each: its docstring is the help, `VERBS` are its own verbs."""
