"""A program's log as JSON: one object a line, with the ids of the present span."""

import json
import subprocess
import sys

TRACE, SPAN = "0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331"


def test_a_line_of_json_names_its_span() -> None:
    code = (
        "import logging\nfrom vram_arbiter.schemas.runtime import logging as "
        "logs\nlogs.set_up('tool', 'info', 'json', '')\nlog = logging.getLogger('a')\n"
        "log.info('before'); log.debug('hidden')\nfrom vram_arbiter.schemas.runtime.telemetry "
        "import spans as tracing\n"
        f"with tracing.joined('00-{TRACE}-{SPAN}-01'):\n    log.warning('%s\\nlines', 'two')\n"
        "try: 1/0\nexcept ZeroDivisionError: log.exception('after')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    before, within, after = [json.loads(line) for line in done.stderr.splitlines()]
    assert (before["message"], before["level"], before["program"], before["logger"]) == (
        "before",
        "info",
        "tool",
        "a",
    )
    assert "trace_id" not in before
    assert (within["trace_id"], within["span_id"], within["message"]) == (TRACE, SPAN, "two\nlines")
    assert "ZeroDivisionError" in after["exception"]
    assert "span_id" not in after
