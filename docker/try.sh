#!/usr/bin/env bash
# Builds the image, runs it as docker/compose.yaml says, and tries what docs/how-to/container.md promises of it.
#
#     docker/try.sh [COMPOSE COMMAND]        # default: docker compose; takes some minutes, most of them the build
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
compose=("${@:-docker compose}")
[[ $# == 0 ]] && compose=(docker compose)
compose+=(--file docker/compose.yaml)
base=http://127.0.0.1:8321

told() { printf '%-34s %s\n' "$1" "$2"; }
fail() { told "$1" "NO: $2"; exit 1; }
until_it() { for _ in $(seq 120); do "$@" &>/dev/null && return 0; sleep 1; done; return 1; }
field() { python3 -c "import json, sys; told = json.load(sys.stdin); print(told$1)"; }
inside() { docker exec "$service" "$@"; }
refused() { ! inside touch "$1" &>/dev/null || fail "written: $1" "the root file system is not read-only"; }

trap 'echo "not as promised: line $LINENO" >&2' ERR
trap '"${compose[@]}" down --volumes &>/dev/null' EXIT
docker build ${BUILD_OPTIONS:-} --file docker/Dockerfile --tag relay-autotuner . >/dev/null
told "image" "$(docker image inspect --format '{{.Size}}' relay-autotuner | awk '{printf "%.0f MB", $1 / 1e6}')"
"${compose[@]}" up --detach &>/dev/null
until_it curl -sf $base/healthz || fail "answers" "$("${compose[@]}" logs --tail 5)"
service=$("${compose[@]}" ps --quiet autotuner)

told "user" "$(inside id -u)"
grep -q 'CapEff:.*[1-9a-f]' "/proc/$(docker inspect --format '{{.State.Pid}}' "$service")/status" &&
    fail "capabilities" "there are some"
told "capabilities" "none"
refused /written
refused /opt/autotuner/written
inside touch /data/written /tmp/written && inside rm /data/written
told "written where" "/data and /tmp only"
inside sh -c 'command -v gcc cc pip pip3' &>/dev/null && fail "compiler, pip" "found"
told "compiler, pip" "none"
healthy() { [[ $(docker inspect --format '{{.State.Health.Status}}' "$service") == healthy ]]; }
until_it healthy || fail "health check" "$(docker inspect --format '{{json .State.Health}}' "$service")"
told "health check" "healthy"

begun() { tuning=$(curl -sf -X POST $base/v1/loops/TIC-101/tunings | field '["links"]["self"]'); }
ended() { [[ $(curl -sf $base"$tuning" | field '["state"]') == ended ]]; }
until_it begun || fail "tuning" "cannot be started"
until_it ended || until_it ended || fail "tuning" "has not ended"
told "tuning" "$(curl -sf $base"$tuning" | field '["verdict"]["message"]')"
sleep 60 # the loop rests again
until_it begun || fail "second tuning" "cannot be started"
in_relay() { [[ $(curl -sf $base"$tuning" | field '["phase"]') == relay ]]; }
until_it in_relay || fail "second tuning" "no relay"
docker kill "$service" >/dev/null
"${compose[@]}" up --detach &>/dev/null
until_it ended || fail "killed in the relay" "not told after the next start"
told "killed in the relay, started" "$(curl -sf $base"$tuning" | field '["verdict"]["code"]'), restored $(curl -sf $base"$tuning" | field '["restored"]')"
since=$(date +%s%N)
docker stop -t 30 "$service" >/dev/null
told "stopped by SIGTERM" "after $((($(date +%s%N) - since) / 1000000)) ms, exit code $(docker inspect --format '{{.State.ExitCode}}' "$service")"
