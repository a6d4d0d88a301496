"""The page of gaponet app by clicking: from real logs to an export. make browser."""

import json
import re
import shutil
import subprocess
import sys
import time

import mujoco
import pytest
from scipy.spatial.transform import Rotation

pytestmark = pytest.mark.browser
MOTIONS = ("center_workspace", "circular_motion", "figure_eight", "triangle_wave")
PATIENCE = 600.0  # s, of a command on a busy machine
FIND = (
    "[...document.querySelectorAll({0})]"
    ".filter(e => (e.innerText || '').trim().startsWith({1}) && e.offsetParent !== null)"
)


class Clicker:
    """What a person does with the page."""

    def __init__(self, browser, address, step=""):
        from browser import wait

        self.browser = browser
        self.wait = wait
        # Few pixels: software draws them.
        browser.ask("Page.navigate", url=f"{address}?fixedDpr=0.15{step}")
        browser.ask("DOM.enable")
        wait(lambda: "1 Robot" in self.text())

    def text(self):
        return self.browser.value("document.body.innerText") or ""

    def sees(self, words):
        end = time.monotonic() + PATIENCE
        while words not in self.text():
            assert time.monotonic() < end, f"no {words} in\n{self.text()}"
            time.sleep(0.5)

    def press(self, x, y):
        for kind in ("mousePressed", "mouseReleased"):
            self.browser.ask(
                "Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1
            )

    def centre(self, elements):
        box = (
            "(e => e && (b => [b.x + b.width / 2, b.y + b.height / "
            f"2])(e.getBoundingClientRect()))({elements}[0])"
        )
        return self.wait(lambda: self.browser.value(box))

    def click(self, label):
        button = FIND.format("'button'", json.dumps(label)) + ".filter(e => !e.disabled)"
        assert self.wait(
            lambda: self.browser.value(f"{button}.length > 0 && ({button}[0].click(), true)")
        )

    def tab(self, label):
        self.press(
            *self.centre(FIND.format("'*'", json.dumps(label)) + ".filter(e => !e.children.length)")
        )

    def field(self, label):
        labels = FIND.format("'label'", json.dumps(label))
        inside = (
            "e => {while (!e.querySelector('input')) e = e.parentElement; return "
            "e.querySelector('input')}"
        )
        return f"{labels}.map({inside})"

    def choose(self, label, option):
        self.press(*self.centre(self.field(label)))
        element = FIND.format("'[role=option]'", json.dumps(option))
        assert self.wait(
            lambda: self.browser.value(f"{element}.length > 0 && ({element}[0].click(), true)")
        )

    def write(self, label, text):
        self.wait(lambda: self.browser.value(f"({self.field(label)}[0].select(), true)"))
        self.browser.ask("Input.insertText", text=text)
        time.sleep(1.0)  # the page sends it after a moment

    def use(self, robot):
        """Go through step Robot and open step Logs."""
        self.choose("robot", robot)
        self.click("Use this robot")
        self.sees("gaponet robot has ended")
        self.tab("2 Logs")

    def upload(self, label, file):
        button = f"{FIND.format(repr('button'), json.dumps(label))}[0]"
        name = self.wait(
            lambda: self.browser.value(
                f"{button}.parentElement.querySelector('input[type=file]').id"
            )
        )
        root = self.browser.ask("DOM.getDocument", depth=0)["root"]["nodeId"]
        node = self.browser.ask("DOM.querySelector", nodeId=root, selector=f"[id='{name}']")[
            "nodeId"
        ]
        self.browser.ask("DOM.setFileInputFiles", files=[str(file)], nodeId=node)


@pytest.fixture
def page(tmp_path):
    pytest.importorskip("viser")
    from gaponet.report.view.app import App

    (tmp_path / "work").mkdir()
    opened = App(tmp_path / "work", 0)
    from browser import ticking

    with ticking(opened.tick):
        yield opened
    opened.jobs.cancel()
    opened.server.stop()


def export_agrees(page):
    """Run the exported check: the model file alone moves as in gaponet."""
    script = page.controls.folder / page.jobs.result("export").out / "check.py"
    check = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, check=True, cwd=script.parent
    )
    alone, ours = map(
        float, re.search(r"alone: ([\d.]+) mrad; in gaponet ([\d.]+)", check.stdout).groups()
    )
    print(check.stdout)
    return alone == pytest.approx(ours, rel=0.05)


def write_z1_urdf(path):
    """Write links, joints, inertias and limits of the Z1's model as URDF, as its maker's file has
    them: no servos.
    """
    from real_robots.cards import ROBOTS

    from gaponet.robot.spec import load_robot

    model = mujoco.MjModel.from_xml_path(str(ROBOTS / "z1" / "robot.xml"))
    robot = load_robot(ROBOTS / "z1")
    effort = dict(zip(robot.joint_names, robot.servo.effort_limit, strict=True))
    lines = ['<robot name="z1"><link name="world"/>']

    def origin(position, quaternion):
        turned = Rotation.from_quat(quaternion, scalar_first=True).as_euler("xyz")
        return f'<origin xyz="{" ".join(map(str, position))}" rpy="{" ".join(map(str, turned))}"/>'

    for body in map(model.body, range(1, model.nbody)):
        inertia = " ".join(
            f'i{n}="{v}"' for n, v in zip(("xx", "yy", "zz"), body.inertia, strict=True)
        )
        inertial = f'{origin(body.ipos, body.iquat)}<mass value="{body.mass[0]}"/>'
        inertial = f'<inertial>{inertial}<inertia {inertia} ixy="0" ixz="0" iyz="0"/></inertial>'
        lines.append(f'<link name="{body.name}">{inertial * bool(body.mass[0])}</link>')
        parent = f'<parent link="{model.body(body.parentid[0]).name}"/><child link="{body.name}"/>'
        parent += origin(body.pos, body.quat)
        if not body.jntnum[0]:
            lines.append(f'<joint name="{body.name}_fixed" type="fixed">{parent}</joint>')
            continue
        joint = model.joint(body.jntadr[0])
        low, high = joint.range
        limit = (
            f'<limit lower="{low}" upper="{high}" effort="{effort[joint.name]}" velocity="3.1"/>'
        )
        axis = f'<axis xyz="{" ".join(map(str, joint.axis))}"/>'
        lines.append(f'<joint name="{joint.name}" type="revolute">{parent}{axis}{limit}</joint>')
    path.write_text("\n".join([*lines, "</robot>"]))


def test_from_a_urdf_and_one_real_chirp_of_a_z1_to_an_export_that_agrees(page, iit_z1, tmp_path):
    """No table of the columns is given: the page guesses it."""
    from browser import Browser

    write_z1_urdf(tmp_path / "z1.urdf")
    with Browser(1000, 700) as browser:
        at = Clicker(browser, page.address)
        at.upload("Upload a model", tmp_path / "z1.urdf")
        at.sees("z1.urdf is stored")
        at.write("joints", " ".join(f"joint{n}" for n in range(1, 7)))
        at.write("kp", "80 joint2=120 joint3=120")
        at.write("kd", "2.5")
        at.use("model/z1.urdf")
        at.upload("Upload a log", iit_z1 / "traj_0.pt")
        at.sees("traj_0.pt is stored")
        at.click("Guess logs.toml")
        at.wait(
            lambda: (
                'ctrl = "des_dof_pos"' in browser.value("document.querySelector('textarea').value")
            )
        )
        at.write("cut into pieces, s", "4")
        at.click("Read the logs")
        at.sees("gaponet import has ended")
        at.tab("3 Check")
        at.click("Check the recordings")
        at.sees("gaponet doctor has ended")
        at.tab("4 Gap")
        at.click("Measure the error")
        at.sees("The nominal simulator is")
        at.tab("5 Identify")
        at.write("rollouts", "12")
        at.click("Identify")
        at.sees("gaponet identify, ")
        at.sees("After identification the error is")
        at.tab("6 Use")
        at.click("Export")
        at.sees("robot.xml alone")
        assert browser.complaints() == []
    assert export_agrees(page)
    errors = page.jobs.result("causes").result["methods"]
    assert errors["identified"]["mpjae"] < 0.3 * errors["nominal"]["mpjae"]


def test_from_real_logs_to_an_export_that_agrees(page, sage_so101, tmp_path):
    """All six steps; the second page shows what the first began; cancelling leaves what was
    there.
    """
    from browser import Browser

    logs = tmp_path / "some" / "logs"
    for motion in MOTIONS:
        (source,) = sage_so101.rglob(f"*/{motion}")
        shutil.copytree(source, logs / motion)
    archive = shutil.make_archive(str(tmp_path / "logs"), "zip", logs)
    with Browser(1000, 700) as first:
        at = Clicker(first, page.address)
        at.use("so101")
        at.click("Read the logs")
        at.sees("gaponet import gave no result")  # there are none
        at.upload("Upload a log", archive)
        at.sees("logs.zip is stored")
        at.click("Read the logs")
        at.sees("4 recordings")
        at.tab("5 Identify")
        at.sees("Check the recordings in step 3 first")
        assert first.value(f"{FIND.format(repr('button'), repr('Identify'))}[0].disabled")
        at.tab("3 Check")
        at.click("Check the recordings")
        at.sees("Usable.")
        assert first.value("[...document.images].some(i => i.naturalWidth > 100)")
        at.tab("4 Gap")
        at.click("Measure the error")
        at.sees("The nominal simulator is")
        at.click("Show the recording")
        at.sees("whole motion")
        at.tab("5 Identify")
        at.write("rollouts", "12")
        first.value("[...document.querySelectorAll('input[type=checkbox]')].at(-1).click()")
        time.sleep(1.0)
        at.click("Identify")
        at.sees("gaponet identify, ")
        assert first.complaints() == []
    assert page.jobs.running.words[0] == "identify"  # the page is closed
    with Browser(1000, 700) as second:
        at = Clicker(second, page.address, "&step=4")
        at.sees("Measure the error")  # step Gap is open
        at.sees("gaponet gap has ended")
        at.tab("5 Identify")
        at.sees("mrad (one motion) → identified")
        at.tab("6 Use")
        at.click("Export")
        at.sees("robot.xml alone")
        at.tab("5 Identify")
        at.click("Identify")
        at.sees("gaponet identify, ")
        before = page.jobs.result("identify").number
        at.click("Cancel")
        at.sees("it was cancelled")
        assert page.jobs.result("identify").number == before
        assert second.complaints() == []
    assert export_agrees(page)


def test_200_megabytes_of_another_robot_are_stored_and_refused_with_the_reason(page, tmp_path):
    from browser import Browser

    names = [
        "time",
        *(f"{kind}.{joint}" for kind in ("ctrl", "qpos") for joint in ("hip", "knee", "ankle")),
    ]
    (tmp_path / "walk.csv").write_text(
        ",".join(names) + "\n" + "0.02,0.1,0.2,0.3,0.1,0.2,0.3\n" * 7_000_000
    )
    with Browser(1000, 700) as browser:
        at = Clicker(browser, page.address)
        at.use("so101")
        at.upload("Upload a log", tmp_path / "walk.csv")
        at.sees("walk.csv is stored")
        at.click("Read the logs")
        at.sees("gaponet import gave no result")
        at.sees("names joints hip, knee, ankle, which robot 'so101' does not have")
        assert browser.complaints() == []


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_the_page_fits_a_desk_and_a_phone_is_readable_and_dark_where_the_system_is(
    page, width, scheme
):
    from browser import Browser, wait

    with Browser(max(width, 500), 720) as browser:
        metrics = {"width": width, "height": 720, "deviceScaleFactor": 1, "mobile": width < 500}
        browser.ask("Emulation.setDeviceMetricsOverride", **metrics)
        browser.ask(
            "Emulation.setEmulatedMedia",
            features=[{"name": "prefers-color-scheme", "value": scheme}],
        )
        at = Clicker(browser, page.address, "&step=6")
        scheme_now = "document.documentElement.dataset.mantineColorScheme"
        # A dark page loads twice.
        wait(lambda: browser.value(scheme_now) == scheme and "Train a network" in at.text())
        assert browser.value("document.documentElement.scrollWidth") <= width
        elements = "document.querySelectorAll('button, label, p, td, input, [role=tab]')"
        letters = f"[...{elements}].filter(e => e.offsetParent)"
        assert browser.value(
            f"{letters}.every(e => parseFloat(getComputedStyle(e).fontSize) >= 12)"
        )
        if width > 500:  # the row of steps works from the keyboard
            browser.value("document.querySelector('[role=tab][aria-selected=true]').focus()")
            browser.ask("Input.dispatchKeyEvent", type="keyDown", key="ArrowLeft", code="ArrowLeft")
            at.sees("look for a table")
        assert browser.complaints() == []
