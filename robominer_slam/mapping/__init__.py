"""The map: keyframes with their points, and what is drawn from them. No I/O."""
