"""A robot and its GPU server, over OpenSSH: nothing of the product listens on a network."""
