"""A project with a consumer of GPU memory."""
