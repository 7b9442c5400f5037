"""OpenTelemetry's names for requests to language models: one span `chat MODEL` a request."""

from vram_arbiter.schemas.runtime.telemetry.names import CHATS_S, metric

TOKENS = tuple(4.0**n for n in range(14))
"""Bounds that OpenTelemetry's conventions give."""

GEN_AI_TOKENS = metric(
    "gen_ai.client.token.usage", "{token}", "Tokens of a request to a language model", TOKENS
)
GEN_AI_DURATION = metric(
    "gen_ai.client.operation.duration", "s", "One request to a language model, all tries", CHATS_S
)
ATTR_REQUEST_MAX_TOKENS = "gen_ai.request.max_tokens"  # spans only, as all below but two
ATTR_RESPONSE_MODEL = "gen_ai.response.model"
ATTR_FINISH_REASONS = "gen_ai.response.finish_reasons"
ATTR_INPUT_TOKENS = "gen_ai.usage.input_tokens"
ATTR_OUTPUT_TOKENS = "gen_ai.usage.output_tokens"
ATTR_TOKEN_TYPE = "gen_ai.token.type"  # metrics only
ATTR_SERVER = "server.address"
ATTR_SERVER_PORT = "server.port"
