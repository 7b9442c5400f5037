"""A robot and a GPU server over OpenSSH, without a protocol of our own: the robot's tunnel, and the
server's restricted keys."""
