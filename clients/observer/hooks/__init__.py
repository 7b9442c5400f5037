"""Commands and webhooks for events: rules, queues, and what they start.

However slow a hook is, no other part of the observer waits.
"""
