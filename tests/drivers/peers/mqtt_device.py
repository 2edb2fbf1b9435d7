"""A heater on MQTT in the manner of Tasmota and ESPHome: plant, PI controller, retained states, last will.

python mqtt_device.py PORT K T D [--user U --password P]; prints a line of JSON once the broker has it. It reports the
PV when it has changed by 0.005 or after 0.5 s, and states (retained) when they are set.
"""
# ruff: noqa: C901, TID251

import argparse
import json
import math
import random
import sys
import time

import paho.mqtt.client as mqtt

SCAN_S = 0.01


class Heater:
    def __init__(self, K, T, D):
        self.K, self.decay, self.line = K, math.exp(-SCAN_S / T), [40.0] * round(D / SCAN_S)
        self.pv, self.out, self.sp, self.auto, self.kp, self.ti, self.integral = (
            40.0 * K,
            40.0,
            40.0 * K,
            False,
            1.0,
            5.0,
            40.0,
        )

    def scan(self):
        error = self.sp - self.pv
        if self.auto:
            self.integral = min(max(self.integral + self.kp / self.ti * error * SCAN_S, 0.0), 100.0)
            self.out = min(max(self.kp * error + self.integral, 0.0), 100.0)
        else:
            self.integral = self.out - self.kp * error
        self.line.append(self.out)
        target = self.K * self.line.pop(0)
        self.pv = target + (self.pv - target) * self.decay


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("port", type=int)
    for name in "KTD":
        parser.add_argument(name, type=float)
    parser.add_argument("--user")
    parser.add_argument("--password")
    args = parser.parse_args()
    heater = Heater(args.K, args.T, args.D)
    client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
    if args.user:
        client.username_pw_set(args.user, args.password)
    client.will_set("dev/status", "offline", 1, True)

    def state(name):
        values = {
            "out": heater.out,
            "mode": "auto" if heater.auto else "off",
            "sp": heater.sp,
            "kp": heater.kp,
            "ti": heater.ti,
        }
        client.publish(f"dev/{name}", json.dumps({name: values[name]}) if name == "out" else str(values[name]), 1, True)

    def on_message(_client, _data, message):
        name, text = message.topic.split("/")[1], message.payload.decode()
        if name == "mode":
            heater.auto = text != "off"
        elif name == "out" and not heater.auto:
            heater.out = min(max(float(text), 0.0), 100.0)
        elif name in {"sp", "kp", "ti"}:
            setattr(heater, name, float(text))
        state(name)

    def on_connect(*_):
        client.subscribe([(f"dev/{name}/set", 1) for name in ("out", "mode", "sp", "kp", "ti")])
        client.publish("dev/status", "online", 1, True)
        for name in ("out", "mode", "sp", "kp", "ti"):
            state(name)
        print(json.dumps({"ready": True}), flush=True)

    client.on_message, client.on_connect = on_message, on_connect
    client.connect("127.0.0.1", args.port, 2)
    client.loop_start()
    begun, scans, told, told_at = time.monotonic(), 0, math.nan, 0.0
    told_out, told_out_at = heater.out, 0.0
    while True:
        time.sleep(SCAN_S)
        now = time.monotonic()
        while begun + scans * SCAN_S < now:
            heater.scan()
            scans += 1
        pv = round(heater.pv + random.gauss(0.0, 0.01), 3)
        if (abs(pv - told) >= 0.005 and now - told_at >= 0.04) or now - told_at >= 0.5 or math.isnan(told):
            client.publish("dev/sensor", json.dumps({"Time": "now", "DS18B20": {"Temperature": pv}}), 0, False)
            told, told_at = pv, now
        if heater.auto and abs(heater.out - told_out) >= 0.01 and now - told_out_at >= 0.04:
            state("out")
            told_out, told_out_at = heater.out, now


if __name__ == "__main__":
    sys.exit(main())
