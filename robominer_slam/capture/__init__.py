"""Captures for calibration: from the whisker device to a labelled recording, and back from one."""
