"""The page in a browser: a tuning from the form to the gains in the device, another aborted, nothing from outside."""

import json

import httpx
import pytest

pytestmark = pytest.mark.realtime

LOOPS = """
[loops.TIC-101]
driver = "modbus"
sample_time_s = 0.05
pv_unit = "degC"
output_unit = "%"
relay = {{ amplitude = 10.0, quiet_s = 1.5 }}
limits = {{ output = [0.0, 100.0], pv = [0.0, 200.0] }}
gains = {{ form = "ideal" }}

[loops.TIC-101.device]
host = "127.0.0.1"
port = {port}

[loops.TIC-101.device.registers]
pv = {{ table = "input", address = 0, type = "int16", scale = 0.1 }}
output = {{ table = "holding", address = 0, type = "int16", scale = 0.1 }}
auto = {{ table = "coil", address = 0 }}
kp = {{ table = "holding", address = 10, type = "float32" }}
ti = {{ table = "holding", address = 12, type = "float32" }}
td = {{ table = "holding", address = 14, type = "float32" }}

[loops.fast]
driver = "simulated"
sample_time_s = 0.02
pv_unit = "rpm"
output_unit = "%"
relay = {{ amplitude = 10.0, quiet_s = 0.6, max_periods = 4, check = false }}
gains = {{ form = "ideal" }}
device = {{ plant = {{ structure = "fopdt", K = 2.0, T = 0.6, D = 0.2 }}, output0 = 40.0, pv0 = 80.0, noise = 0.05 }}
"""
HELD = "document.querySelector('[data-applied]')"


@pytest.fixture
def service(start):
    """Return the address of a service with a simulated PLC and a simulated loop behind it."""
    plc = start("plc", "--port", "0", "--scan", "0.02")
    return start("serve", "--port", "0", config=LOOPS.format(port=plc["port"]))["listening"]


def check_quiet(browser, service):
    """Check that the page logged no complaint, and asked nothing of anybody but the service."""
    assert browser.complaints() == []
    assert browser.hosts() == {service.removeprefix("http://")}


def begin(browser, service, loop):
    """Start a tuning from the form, with the keyboard where it matters."""
    browser.open(f"{service}/#/loops/{loop}")
    browser.wait("document.querySelectorAll('.steps li').length === 4")
    browser.click("form button.main")
    browser.wait("document.querySelector('dialog[open] button.main') === document.activeElement")
    browser.press("Enter", "Enter", 13)
    browser.wait("location.hash.startsWith('#/tunings/')")


def test_a_loop_is_tuned_and_its_gains_are_written_and_put_back(browser, service, shots):
    browser.size(1280)
    begin(browser, service, "fast")
    browser.wait("document.querySelector('[data-phase=relay].now')")
    browser.wait("document.querySelector('.readout').textContent.includes('PV')")
    first = browser.run("document.querySelector('.readout').textContent")
    browser.wait(f"document.querySelector('.readout').textContent !== {json.dumps(first)}")
    browser.picture(shots / "live.png")
    assert browser.wait("document.querySelector('[data-verdict]')?.dataset.verdict", 90.0) == "done"
    browser.wait("document.querySelectorAll('canvas').length >= 3", 60.0)
    browser.picture(shots / "result.png")
    told = browser.run("document.querySelector('[aria-label=Model]').innerText")
    assert "first order with dead time" in told
    with httpx.Client(base_url=service) as client:
        before = client.get("/v1/loops/fast/gains").json()["values"]
        wanted = client.get(client.get("/v1/tunings").json()["tunings"][0]["links"]["self"]).json()["gains"]
        for button, expected in (("Apply …", wanted["Kp"]), ("Roll back …", before["kp"])):
            found = f"[...document.querySelectorAll('button')].find((b) => b.textContent === {json.dumps(button)})"
            browser.wait(f"{found} && !{found}.disabled")
            shown = browser.run(f"{HELD}?.dataset.applied ?? ''")
            browser.run(f"{found}.click()")
            browser.click("dialog[open] button.main")
            browser.wait(f"{HELD} && {HELD}.dataset.applied !== {json.dumps(shown)}")
            assert client.get("/v1/loops/fast/gains").json()["values"]["kp"] == pytest.approx(expected, rel=1e-6)
    browser.size(390, 844, "dark")
    browser.wait("document.documentElement.scrollWidth <= 390")
    browser.picture(shots / "result-390-dark.png")
    check_quiet(browser, service)


def test_a_tuning_of_a_plc_is_aborted_from_another_view(browser, service, shots):
    browser.size(390, 844)
    browser.open(service)
    browser.wait("document.querySelector('[data-loop=\"TIC-101\"] .pv b').textContent.startsWith('8')")
    browser.picture(shots / "loops-390.png")
    begin(browser, service, "TIC-101")
    browser.wait("document.querySelector('[data-phase=relay].now')", 60.0)
    browser.open(f"{service}/#/recording")
    browser.click("[data-abort]")
    browser.open(f"{service}/#/tunings")
    browser.wait("[...document.querySelectorAll('tbody td')].some((cell) => cell.textContent === 'requested')", 60.0)
    with httpx.Client(base_url=service) as client:
        path = client.get("/v1/tunings").json()["tunings"][0]["links"]["self"]
        assert client.get(path).json()["restored"] is True
    check_quiet(browser, service)


def test_a_recording_is_dropped_and_identified(browser, service, shots):
    rows = [(k / 10, float(k >= 10), 2.0 * (1.0 - 0.9 ** max(k - 15, 0))) for k in range(120)]
    content = json.dumps("t,u,y\n" + "\n".join(",".join(map(str, row)) for row in rows))
    browser.size(1280)
    browser.open(f"{service}/#/recording")
    browser.wait("document.querySelector('.drop')")
    browser.run(
        f"""(() => {{
        const data = new DataTransfer();
        data.items.add(new File([{content}], "step.csv", {{ type: "text/csv" }}));
        const event = new DragEvent("drop", {{ dataTransfer: data, cancelable: true }});
        document.querySelector(".drop").dispatchEvent(event);
        }})()"""
    )
    browser.wait("document.querySelector('[aria-label=\"Measured against model\"] canvas')", 60.0)
    browser.picture(shots / "recording.png")
    check_quiet(browser, service)


def test_the_browser_is_told_to_run_nothing_else(service):
    answer = httpx.get(service)
    policy = dict(part.strip().split(" ", 1) for part in answer.headers["content-security-policy"].split(";"))
    assert policy["default-src"] == "'none'"
    assert policy["script-src"] == policy["style-src"] == policy["connect-src"] == "'self'"
    assert "onclick" not in answer.text
    assert "<style" not in answer.text
