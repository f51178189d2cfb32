"""The program's parameters: one typed model with unit, default, range and reason for each."""
