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
MIDDLE = "...((b) => [b.x + b.width / 2, b.y + b.height / 2])({}.getBoundingClientRect())"
"""Of an element, as two arguments."""

STEP = [(k / 10, float(k >= 10), 2.0 * (1.0 - 0.9 ** max(k - 15, 0))) for k in range(120)]
SIZES = [(1280, 900, "light"), (390, 844, "dark")]


@pytest.fixture(scope="module")
def service(chromium, start):  # a browser first: without one nothing is started
    """Return the address of a service with a simulated PLC and a simulated loop behind it."""
    plc = start("plc", "--port", "0", "--scan", "0.02")
    return start("serve", "--port", "0", config=LOOPS.format(port=plc["port"]))["listening"]


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
    browser.click("form button.main")
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
        "Skip to the content", "relay-autotuner", "Loops", "Tunings", "Recording", "Audit", "TIC-101",
    ]  # fmt: skip
    begin(browser, service, "TIC-101")
    browser.wait("document.querySelector('[data-phase=relay].now')", 60.0)
    look("live")
    browser.open(f"{service}/#/recording")
    browser.click("[data-abort]")
    browser.open(f"{service}/#/tunings")
    browser.wait("[...document.querySelectorAll('tbody td')].some((cell) => cell.textContent === 'requested')", 60.0)
    with httpx.Client(base_url=service) as client:
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
    assert browser.wait("document.querySelector('[data-verdict]')?.dataset.verdict", 90.0) == "done"
    browser.wait("document.querySelectorAll('canvas').length >= 3", 60.0)
    assert "first order with dead time" in browser.run("document.querySelector('[aria-label=Model]').innerText")
    assert browser.run("document.querySelector('[aria-label=Diagnosis] table').innerText").count("fitted") == 2
    look("result")
    with httpx.Client(base_url=service) as client:
        before = client.get("/v1/loops/fast/gains").json()["values"]
        wanted = client.get(client.get("/v1/tunings").json()["tunings"][0]["links"]["self"]).json()["gains"]
        for button, expected in (("Apply …", wanted["Kp"]), ("Roll back …", before["kp"])):
            shown = browser.run(f"{HELD}?.dataset.applied ?? ''")
            press_button(browser, button)
            browser.click("dialog[open] button.main")
            browser.wait(f"{HELD} && {HELD}.dataset.applied !== {json.dumps(shown)}")
            assert client.get("/v1/loops/fast/gains").json()["values"]["kp"] == pytest.approx(expected, rel=1e-6)
    check_quiet(browser, service)


def test_a_tuned_loop_is_watched(browser, service, look):
    browser.open(f"{service}/#/loops/fast")
    press_button(browser, "Watch this loop")
    browser.wait("document.querySelector('[data-watch]').textContent === 'Watch no more'")
    with httpx.Client(base_url=service) as client:
        path = "/v1/loops/fast/monitor"
        assert client.get(path).json()["state"] == "watching"
        client.post(path, json={"window_s": 9.0}).raise_for_status()
    assert browser.wait("document.querySelector('[data-finding]')?.dataset.finding", 60.0) == "at_rest"
    look("watch")
    browser.open(service)
    browser.wait("document.querySelector('[data-loop=fast] .row .badge')?.textContent === 'at rest'")
    browser.open(f"{service}/#/loops/fast")
    press_button(browser, "Watch no more")
    browser.wait("document.querySelector('[data-watch]').textContent === 'Watch this loop'")
    check_quiet(browser, service)


def test_two_tunings_of_the_history_are_compared(browser, service, look):
    browser.open(f"{service}/#/tunings")
    browser.wait("document.querySelectorAll('tbody input').length >= 2")
    browser.run("[...document.querySelectorAll('tbody input')].slice(0, 2).forEach((box) => box.click())")
    press_button(browser, "Compare the two")
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
    assert text.index("put the old gains back") < text.index("wrote gains") < text.index("started a tuning")
    assert "TIC-101" not in text
    browser.run("document.querySelector('select').value = ''")
    browser.run("document.querySelector('select').dispatchEvent(new Event('change'))")
    browser.wait("document.querySelector('tbody')?.innerText.includes('aborted the tuning')")
    check_quiet(browser, service)


@pytest.mark.parametrize(
    ("kind", "shown"), [("identifications", "Measured against model"), ("diagnoses", "Before and after")]
)
def test_a_recording_is_dropped(browser, service, look, kind, shown):
    content = json.dumps("t,u,y\n" + "\n".join(",".join(map(str, row)) for row in STEP))
    browser.open(f"{service}/#/recording")
    browser.wait("document.querySelector('.drop')")
    browser.run(
        f"""(() => {{
        document.querySelector("[name=kind]").value = "{kind}";
        const data = new DataTransfer();
        data.items.add(new File([{content}], "step.csv", {{ type: "text/csv" }}));
        const event = new DragEvent("drop", {{ dataTransfer: data, cancelable: true }});
        document.querySelector(".drop").dispatchEvent(event);
        }})()"""
    )
    browser.wait(f"document.querySelector('[aria-label=\"{shown}\"] canvas')", 60.0)
    look(kind)
    check_quiet(browser, service)


def test_the_browser_is_told_to_run_nothing_else(service):
    answer = httpx.get(service)
    policy = dict(part.strip().split(" ", 1) for part in answer.headers["content-security-policy"].split(";"))
    assert policy["default-src"] == "'none'"
    assert policy["script-src"] == policy["style-src"] == policy["connect-src"] == "'self'"
    assert "onclick" not in answer.text
    assert "<style" not in answer.text
