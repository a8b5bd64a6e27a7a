"""What a person starts: the command line, the pages served on this machine, and the chapter."""
