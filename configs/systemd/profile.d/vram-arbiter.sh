# shellcheck shell=sh
# The clients of a login shell use the arbiter of the machine, not one of their user.
export VRAM_ARBITER_ENDPOINT="${VRAM_ARBITER_ENDPOINT:-ipc:///run/vram-arbiter/arbiter.sock}"
