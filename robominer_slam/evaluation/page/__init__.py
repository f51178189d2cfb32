"""The evaluation of many runs as one HTML page with the thesis's figures 16 to 30. Needs matplotlib."""
