"""What is wrong with configuration, keys and connection, and the command that mends it."""
