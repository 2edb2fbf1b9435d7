"""The page in a browser: a tuning from the form to the gains in the device, another aborted, nothing from outside."""

import json

import httpx
import pytest

from tests.control.processes import PATIENCE_S

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

[loops.TIC-404]
driver = "modbus"
sample_time_s = 0.5
limits = {{ output = [0.0, 100.0] }}

[loops.TIC-404.device]
host = "127.0.0.1"
port = 9

[loops.TIC-404.device.registers]
pv = {{ table = "input", address = 0 }}
output = {{ table = "holding", address = 0 }}

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
MIDDLE = "...((b) => [b.x + b.width / 2, b.y + b.height / 2])({}.getBoundingClientRect())"
"""Of an element, as two arguments."""

STEP = [(k / 10, float(k >= 10), 2.0 * (1.0 - 0.9 ** max(k - 15, 0))) for k in range(120)]
SIZES = [(1280, 900, "light"), (390, 844, "dark")]


@pytest.fixture(scope="module")
def service(chromium, start):  # a browser first: without one nothing is started
    """Return the address of a service with a simulated PLC and a simulated loop behind it."""
    plc = start("plc", "--port", "0", "--scan", "0.02")
    return start("serve", "--json", "--port", "0", config=LOOPS.format(port=plc["port"]))["listening"]


@pytest.fixture
def look(browser, shots, accessibility):
    """Return a function that keeps pictures of what is shown, wide and narrow, light and dark, and checks them."""

    def take(name):
        for width, height, scheme in SIZES:
            browser.size(width, height, scheme)
            browser.wait(f"document.documentElement.scrollWidth <= {width}")
            browser.picture(shots / f"{name}-{width}-{scheme}.png")
            assert accessibility.problems(browser) == [], f"{name} at {width}, {scheme}"
        browser.size(1280)

    return take


def check_quiet(browser, service):
    """Check that the page logged no complaint, and asked nothing of anybody but the service."""
    assert browser.complaints() == []
    assert browser.hosts() == {service.removeprefix("http://")}


def begin(browser, service, loop):
    """Start a tuning from the form, with the keyboard where it matters."""
    browser.open(f"{service}/#/loops/{loop}")
    browser.wait("document.querySelectorAll('.steps li').length === 4")
    browser.click("[data-start]")
    browser.wait("document.querySelector('dialog[open] button.main') === document.activeElement")
    browser.press("Enter", "Enter", 13)
    browser.wait("location.hash.startsWith('#/tunings/')")


def press_button(browser, text):
    """Press the button with this text, once it can be pressed."""
    found = f"[...document.querySelectorAll('button')].find((b) => b.textContent === {json.dumps(text)})"
    browser.wait(f"{found} && !{found}.disabled")
    browser.run(f"{found}.click()")


def test_a_tuning_of_a_plc_is_aborted_from_another_view(browser, service, look, accessibility):
    browser.size(390, 844)
    browser.open(service)
    browser.wait("document.querySelector('[data-loop=\"TIC-101\"] .pv b').textContent.startsWith('8')")
    look("loops")
    assert accessibility.focus_order(browser, 7) == [
        "Skip to the content", "relay-autotuner", "Loops", "History", "Upload", "Audit", "TIC-101",
    ]  # fmt: skip
    begin(browser, service, "TIC-101")
    browser.wait("document.querySelector('[data-phase=relay].now')")
    look("live")
    browser.open(f"{service}/#/upload")
    browser.click("[data-abort]")
    browser.open(f"{service}/#/tunings")
    browser.wait("[...document.querySelectorAll('tbody td')].some((cell) => cell.textContent.includes('requested'))")
    with httpx.Client(base_url=service, timeout=PATIENCE_S) as client:
        path = client.get("/v1/tunings").json()["tunings"][0]["links"]["self"]
        assert client.get(path).json()["restored"] is True
    check_quiet(browser, service)


MANY = """(() => {
    const asked = window.fetch;
    window.fetch = async (path, options) => {
        const answer = await asked(path, options);
        if (path !== "/v1/loops") return answer;
        const { loops } = await answer.json();
        const many = Array.from({ length: 16 }, (_, k) => ({ ...loops[0], name: `TIC-${k}`, tuning_id: `${k}` }));
        return new Response(JSON.stringify({ loops: many }));
    };
    window.dispatchEvent(new Event("tunings-changed"));
})()"""
"""Has the service tell of sixteen loops that are all being tuned."""


@pytest.mark.parametrize(("width", "height"), [(1280, 900), (390, 844), (320, 640)])
def test_many_tunings_at_once_leave_room_for_what_is_looked_at(browser, service, shots, width, height):
    browser.size(width, height)
    browser.open(f"{service}/#/audit")
    browser.wait("document.querySelector('h1')")
    browser.run(MANY)
    browser.wait("document.querySelectorAll('[data-abort]').length === 16")
    browser.picture(shots / f"many-{width}.png")
    taken = browser.run("document.getElementById('running').getBoundingClientRect().height")
    assert taken <= 0.45 * height
    assert browser.run("document.documentElement.scrollWidth") <= width
    last = "document.querySelector('[data-abort=\"15\"]')"
    browser.run(f"{last}.focus()")
    assert browser.run(f"document.elementFromPoint({MIDDLE.format(last)}) === {last}")


READYZ = """(() => {
    const fetched = window.fetch;
    window.fetch = async (path, options) => path === "/readyz"
        ? new Response(JSON.stringify(%s), { status: %d, headers: { "Content-Type": "application/json" } })
        : fetched(path, options);
})()"""


@pytest.mark.parametrize(
    ("status", "answer", "shown"),
    [
        (200, {"status": "ok", "loops": [{"loop": "fast", "link": "up"}]}, "ready"),
        (200, {"status": "degraded", "loops": [{"loop": "fast", "link": "down"}]}, "fast down"),
        (200, {"status": "degraded", "loops": [{"loop": "fast", "link": "down"}] * 3}, "3 loops down"),
        (507, {"title": "The results cannot be kept", "status": 507}, "not ready: The results cannot be kept"),
    ],
)
def test_every_view_says_what_a_start_would_meet(browser, service, accessibility, status, answer, shown):
    browser.open(f"{service}/#/tunings")
    browser.size(390, 844)
    browser.run(READYZ % (json.dumps(answer), status))
    browser.wait(f"document.getElementById('link').textContent === {json.dumps(shown)}")
    browser.wait("document.documentElement.scrollWidth <= 390")
    assert accessibility.problems(browser) == []
    browser.size(1280)


def test_a_loop_is_tuned_and_its_gains_are_written_and_put_back(browser, service, look):
    browser.size(1280)
    browser.open(f"{service}/#/loops/fast")
    browser.wait("document.querySelector('[aria-label=\"Gains in the device\"] dd')")
    look("form")
    begin(browser, service, "fast")
    browser.wait("document.querySelector('[data-phase=relay].now')")
    browser.wait("document.querySelector('.readout').textContent.includes('PV')")
    first = browser.run("document.querySelector('.readout').textContent")
    browser.wait(f"document.querySelector('.readout').textContent !== {json.dumps(first)}")
    assert browser.wait("document.querySelector('[data-verdict]')?.dataset.verdict") == "done"
    browser.wait("document.querySelectorAll('canvas').length >= 3")
    assert "first order with dead time" in browser.run("document.querySelector('[aria-label=Model]').innerText")
    table = "document.querySelector('[aria-label=Diagnosis] table')?.innerText"
    parts = browser.wait(f"{table}?.includes('kept for the test') && {table}")
    assert [parts.count(part) for part in ("was fitted", "chose the explanation", "kept for the test")] == [1, 1, 1]
    look("result")
    with httpx.Client(base_url=service, timeout=PATIENCE_S) as client:
        before = client.get("/v1/loops/fast/gains").json()["values"]
        wanted = client.get(client.get("/v1/tunings").json()["tunings"][0]["links"]["self"]).json()["gains"]
        for button, expected in (("Apply …", wanted["Kp"]), ("Restore gains …", before["kp"])):
            shown = browser.run(f"{HELD}?.dataset.applied ?? ''")
            press_button(browser, button)
            browser.click("dialog[open] button.main")
            browser.wait(f"{HELD} && {HELD}.dataset.applied !== {json.dumps(shown)}")
            assert client.get("/v1/loops/fast/gains").json()["values"]["kp"] == pytest.approx(expected, rel=1e-6)
    check_quiet(browser, service)


def newest_of_the_quick_loop(client):
    """Return the links of its newest tuning; it is tuned first where a test runs without those before it."""
    tunings = client.get("/v1/tunings?loop=fast").json()["tunings"]
    if tunings:
        return tunings[0]["links"]
    links = client.post("/v1/loops/fast/tunings").json()["links"]
    client.get(links["events"]).raise_for_status()  # they end with the tuning
    return links


WATCH_THE_STEP = """
new MutationObserver(() => {
    const disabled = (one) => one.disabled, abort = document.querySelector("[data-verification] button.abort");
    if (!document.querySelector("[data-step=step].now") || !abort) return;
    const others = [...document.querySelectorAll(".summary button")];
    window.inTheStep = {
        others: others.every(disabled) ? "disabled" : "enabled",
        abort: disabled(abort) ? "disabled" : "enabled",
    };
}).observe(document.body, {subtree: true, childList: true, attributes: true}) ?? true
"""
"""Takes note of the buttons at each change of the page in the step, which a busy machine may be too slow to look at."""


def test_a_verification_is_shown_live_and_kept(browser, service, look):
    with httpx.Client(base_url=service, timeout=PATIENCE_S) as client:
        links = newest_of_the_quick_loop(client)
        browser.open(f"{service}/#/tunings/{links['self'].rpartition('/')[2]}")
        press_button(browser, "Apply …")
        browser.click("dialog[open] button.main")
        press_button(browser, "Verify …")
        browser.run(WATCH_THE_STEP)
        browser.click("dialog[open] button.main")
        assert browser.wait("window.inTheStep") == {"others": "disabled", "abort": "enabled"}
        browser.wait("document.querySelector('[data-verification] canvas')")
        look("verification")
        now = "document.querySelector('[data-verification]').dataset.verification"
        passed = browser.wait(f"{now} !== 'running' && {now}")
        browser.open("about:blank")
        browser.open(f"{service}/#/tunings/{links['self'].rpartition('/')[2]}")
        browser.wait(f"document.querySelector('[data-verification=\"{passed}\"] canvas')")
        look("verified")
        told = client.get(links["self"]).json()["verification"]
        assert (told["passed"], told["rolled_back"]) == (passed == "true", passed == "false")
        shown = browser.run("document.querySelector('[data-verification]').innerText")
        assert all(f"{value:.6g}" in shown for value in told["gains"]["read_back"].values())
        if told["passed"]:
            client.post(links["rollback"]).raise_for_status()
    check_quiet(browser, service)


@pytest.mark.parametrize(("width", "height"), [(1440, 900), (1280, 800), (390, 844)])
def test_the_first_screen_has_state_trend_and_start(browser, service, width, height):
    browser.size(width, height)
    browser.open(f"{service}/#/loops/TIC-101")
    browser.wait("document.querySelector('[data-state=ready]')")
    for shown in ("[data-state]", "[aria-label=Trend] canvas", "[data-start]"):
        box = browser.run(f"document.querySelector({json.dumps(shown)}).getBoundingClientRect().toJSON()")
        assert box["height"] > 0.0, shown
        assert 0.0 <= box["top"] <= box["bottom"] <= height, shown
        assert 0.0 <= box["left"] <= box["right"] <= width, shown


def test_a_dead_link_is_a_state_with_a_cause(browser, service, look):
    browser.open(f"{service}/#/loops/TIC-404")
    browser.wait("document.querySelector('[data-state=dead]')")
    assert browser.run("document.querySelector('[data-start]').disabled")
    assert "refused the connection" in browser.run("document.querySelector('[data-trouble=dead]').innerText")
    look("dead")
    check_quiet(browser, service)


def test_a_picture_is_zoomed_and_read(browser, service):
    with httpx.Client(base_url=service, timeout=PATIENCE_S) as client:
        tuning = client.get("/v1/tunings?loop=fast").json()["tunings"][0]["id"]
    browser.open(f"{service}/#/tunings/{tuning}")
    chart = "document.querySelector('[aria-label=\"Measured against model\"]')"
    browser.wait(f"{chart}?.querySelector('.readout .key')")
    browser.run(f"{chart}.querySelector('canvas').focus()")
    whole = browser.run(f"{chart}.querySelector('.readout').textContent")
    browser.press("Home", "Home", 36)
    told = f"{chart}.querySelector('.readout').textContent"
    browser.wait(f"{told} !== {json.dumps(whole)}")
    first = browser.run(told)
    assert first.startswith("t 0")
    pixels = f"{chart}.querySelector('canvas').toDataURL()"
    browser.run(f"window.before = {pixels}")
    for name in ("Zoom in", "Later", "Show all times"):
        browser.run(f"{chart}.querySelector('[aria-label=\"{name}\"]').click()")
        browser.wait(f"{pixels} !== window.before")
        browser.run(f"window.before = {pixels}")


def test_a_tuned_loop_is_monitored(browser, service, look):
    browser.open(f"{service}/#/loops/fast")
    press_button(browser, "Start monitoring")
    browser.wait("document.querySelector('[data-monitor]').textContent === 'Stop monitoring'")
    with httpx.Client(base_url=service, timeout=PATIENCE_S) as client:
        path = "/v1/loops/fast/monitor"
        assert client.get(path).json()["state"] == "watching"
        client.post(path, json={"window_s": 9.0}).raise_for_status()
    assert browser.wait("document.querySelector('[data-finding]')?.dataset.finding") == "at_rest"
    look("monitoring")
    browser.open(service)
    browser.wait("document.querySelector('[data-loop=fast] .row .badge')?.textContent === 'at rest'")
    browser.open(f"{service}/#/loops/fast")
    press_button(browser, "Stop monitoring")
    browser.wait("document.querySelector('[data-monitor]').textContent === 'Start monitoring'")
    check_quiet(browser, service)


def test_two_tunings_of_the_history_are_compared(browser, service, look):
    browser.open(f"{service}/#/tunings")
    browser.wait("document.querySelectorAll('tbody input').length >= 2")
    browser.run("[...document.querySelectorAll('tbody input')].slice(0, 2).forEach((box) => box.click())")
    press_button(browser, "Compare two tunings")
    browser.wait("document.querySelector('[aria-label=\"Both recordings\"] canvas')")
    look("comparison")
    text = browser.run("document.querySelector('table.wrapped').innerText")
    assert "First: fast" in text
    assert "Second: TIC-101" in text
    check_quiet(browser, service)


def test_the_audit_of_a_loop_tells_who_did_what(browser, service, look):
    browser.open(f"{service}/#/loops/fast")
    link = "[...document.querySelectorAll('a')].find((link) => link.hash === '#/audit/fast')"
    browser.wait(link)
    browser.run(f"{link}.click()")
    browser.wait("document.querySelectorAll('tbody tr').length >= 3")
    look("audit")
    rows = [" ".join(row.split()) for row in browser.run("document.querySelector('tbody').innerText").splitlines()]
    assert [row for row in rows if "local" in row][-1].endswith("done")
    text = " ".join(rows)
    assert text.rindex("restored the gains before") < text.rindex("wrote gains") < text.rindex("started a tuning")
    assert "TIC-101" not in text
    browser.run("document.querySelector('select').value = ''")
    browser.run("document.querySelector('select').dispatchEvent(new Event('change'))")
    browser.wait("document.querySelector('tbody')?.innerText.includes('aborted the tuning')")
    check_quiet(browser, service)


@pytest.mark.parametrize(
    ("kind", "shown"), [("identifications", "Measured against model"), ("diagnoses", "Before and after")]
)
def test_a_recording_is_dropped(browser, service, look, kind, shown):
    table = "minutes;tank;heater\n" + "\n".join(
        ";".join(f"{cell:.6f}".replace(".", ",") for cell in (t / 60, y, u)) for t, u, y in STEP
    )
    browser.open(f"{service}/#/upload")
    browser.wait("document.querySelector('.drop')")
    browser.run(
        f"""(() => {{
        const data = new DataTransfer();
        data.items.add(new File([{json.dumps(table)}], "step.csv", {{ type: "text/csv" }}));
        const event = new DragEvent("drop", {{ dataTransfer: data, cancelable: true }});
        document.querySelector(".drop").dispatchEvent(event);
        }})()"""
    )
    mapping = "document.querySelector('[aria-label=\"Columns and units\"] form')"
    browser.wait(mapping)
    for name, value in (("t", "0"), ("y", "1"), ("u", "2"), ("unit", "60"), ("pv_unit", "degC")):
        browser.run(f"{mapping}.elements['{name}'].value = '{value}'")
    browser.run(f"{mapping}.dispatchEvent(new Event('input'))")
    assert "120 samples over 12 s" in browser.wait(
        "document.querySelector('[aria-label=\"Columns and units\"]').innerText"
    )
    look(f"mapping-{kind}")
    press_button(browser, "Identify" if kind == "identifications" else "Diagnose")
    browser.wait(f"document.querySelector('[aria-label=\"{shown}\"] canvas')")
    if kind == "identifications":  # K 2 of a heater in the third column, over minutes
        assert "degC/output" in browser.run("document.querySelector('[aria-label=Model]').innerText")
    look(kind)
    check_quiet(browser, service)


def test_the_browser_is_told_to_run_nothing_else(service):
    answer = httpx.get(service, timeout=PATIENCE_S)
    policy = dict(part.strip().split(" ", 1) for part in answer.headers["content-security-policy"].split(";"))
    assert policy["default-src"] == "'none'"
    assert policy["script-src"] == policy["style-src"] == policy["connect-src"] == "'self'"
    assert "onclick" not in answer.text
    assert "<style" not in answer.text
