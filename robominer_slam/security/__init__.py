"""Who may connect to the robot and do what there: an authority, certificates, the access list, Zenoh's rules."""
