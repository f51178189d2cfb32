"""The command line: one file per subcommand, thin; results to stdout, logs to stderr."""
