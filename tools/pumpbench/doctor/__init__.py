"""Is a device wired right, and does it speak the protocol? One check after the other, in words."""
