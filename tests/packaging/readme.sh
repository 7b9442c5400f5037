#!/usr/bin/env bash
# Type the commands of README.md (or of PAGE), one by one, in one shell, as a reader does.
#
#   tests/packaging/readme.sh [SECTION...]     in a fresh clone; without a section all of them
#
# SKIP='regular expression' leaves lines out and says so. A line that ends in `&` goes on in the
# background: what comes next waits until it serves. A line whose comment says `Ctrl-C` gets one
# after 3 s. Everything in the background ends with the script.
set -uo pipefail

page=${PAGE:-README.md}
[ -f "$page" ] || { echo "readme.sh: no $page here: start it in a clone" >&2; exit 2; }
sections=("$@")
runtime=${XDG_RUNTIME_DIR:?readme.sh: XDG_RUNTIME_DIR is not set}

commands() { # the lines of the `sh` blocks, of all sections or of those asked for
    awk -v wanted="$(IFS='|'; echo "${sections[*]-}")" '
        /^## / { here = wanted == "" || index("|" wanted "|", "|" substr($0, 4) "|") }
        /^```sh$/ { inside = here; next }
        /^```/ { inside = 0 }
        inside && NF' "$page"
}

end() {
    for job in $(jobs -p); do kill "$job" 2>/dev/null; done
    wait
}
trap end EXIT

sockets() { find "$runtime" -type s 2>/dev/null | sort; }

serves() { # serves PID SOCKETS: wait for another socket, or for the program that `vramctl run` starts
    local pid=$1 before=$2 deadline=$((SECONDS + 120))
    while [ "$SECONDS" -lt "$deadline" ]; do
        kill -0 "$pid" 2>/dev/null || { wait "$pid"; return; }
        [ "$(sockets)" = "$before" ] || return 0
        [[ $typed = "vramctl run "* && -n $(cat "/proc/$pid/task/$pid/children" 2>/dev/null) ]] && return 0
        sleep 0.1
    done
    return 1
}

count=0
while IFS= read -r line <&3; do
    typed=$(sed -E 's/[[:space:]]{2,}# .*$//' <<<"$line")
    if [ -n "${SKIP:-}" ] && grep -qE "$SKIP" <<<"$typed"; then
        echo "-- left out: $typed"
        continue
    fi
    echo "\$ $typed"
    count=$((count + 1))
    case $line in
    *Ctrl-C*)
        # shellcheck disable=SC2086  # words of a command
        timeout --foreground --signal=INT --kill-after=30 3 $typed
        code=$?
        [ "$code" = 124 ] || [ "$code" = 130 ] && code=0
        ;;
    *)
        before=$(sockets)
        eval "$typed" 3<&-
        code=$?
        case $typed in *'&') serves $! "$before"; code=$? ;; esac
        ;;
    esac
    [ "$code" = 0 ] || { echo "readme.sh: exit code $code of: $typed" >&2; exit 1; }
done 3< <(commands)
[ "$count" -gt 0 ] || { echo "readme.sh: no command was found" >&2; exit 1; }
echo "$count commands of $page work"
