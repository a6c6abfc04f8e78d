"""The console program `pc2grid`: one file per subcommand."""
