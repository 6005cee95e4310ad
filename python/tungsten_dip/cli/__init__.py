"""The commands. Only code in here prints, reads the command line or ends the process."""
