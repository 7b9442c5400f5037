"""What a program of the tests tells the test that started it: JSON, one event a line."""

import json


def say(event: str, **facts: object) -> None:
    """Print one event at once."""
    print(json.dumps({"event": event, **facts}), flush=True)
