"""Commands and webhooks for events: the library behind `vramctl hooks`.

A program of its own, an observer of the arbiter: however slow a hook is, the daemon does not wait.
"""
