"""From magnetic vectors to whisker angles, and how that is fitted."""
