"""Where measurements come from: serial ports, a recording, or Zenoh from another board."""
