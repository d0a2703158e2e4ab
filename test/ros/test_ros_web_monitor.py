"""The live page in a browser: estimates, alarms, streams and buttons of an identifier."""

import threading
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
import rclpy
from browser import DESKTOP, PHONE
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from drawn_estimates import drawn_estimate
from rclpy.context import Context
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from symbid_ros.model.load import load_model
from symbid_ros.package_paths import config_file
from symbid_ros.ros.endpoints import reliable_qos
from symbid_ros.ros.estimate_topics import EstimateTopics
from symbid_ros.ros.web_monitor import PARAMETERS, WebMonitor

MODEL = config_file("symbitron.xml")
DEADLINE = 200_000  # ms; only a hang takes longer
ALARM = "L_thigh has changed since 15.0 s: +3.00 ± 0.10 kg"
FOLLOWED = "L_thigh has changed; the estimate is of later data"


class Identifier:
    """The topics and services of an identifier, with an estimate that is drawn."""

    def __init__(self, context: Context) -> None:
        self.node = Node("identifier", context=context)
        self.parameters, self.estimate = drawn_estimate(load_model(MODEL))
        self.topics = EstimateTopics(self.node, self.parameters)
        self.diagnostics = self.node.create_publisher(
            DiagnosticArray, "/diagnostics", reliable_qos(10)
        )
        self.joints = self.node.create_publisher(JointState, "joint_states", 10)
        self.calls: list[str] = []
        for name in ("solve", "save", "reset"):
            self.node.create_service(Trigger, f"~/{name}", self._answer_of(name))

    def _answer_of(self, name: str) -> Any:
        def answer(_: Any, response: Any) -> Any:
            self.calls.append(name)
            response.success = name != "save"
            response.message = {"save": "parameter out: empty"}.get(name, f"{name} done")
            return response

        return answer

    def publish(self, seconds: int, thigh: float, change: str = ALARM) -> None:
        """Publish an estimate with another mass of a thigh, and what else a page shows."""
        value = self.estimate.value.copy()
        value[self.estimate.names.index("L_thigh/m")] = thigh
        self.topics.publish(replace(self.estimate, value=value), Time(sec=seconds))
        statuses = {
            "estimate": (DiagnosticStatus.OK, {"age": "0.5", "samples": "433"}, "published"),
            "streams": (DiagnosticStatus.OK, {"/joint_states/rate": "1000.0"}, "in order"),
            "change": (
                DiagnosticStatus.WARN if change == ALARM else DiagnosticStatus.OK,
                {"link": "L_thigh", "since": "1.0"},
                change,
            ),
        }
        message = DiagnosticArray()
        for part, (level, values, text) in statuses.items():
            message.status.append(
                DiagnosticStatus(
                    name=f"/identifier: {part}",
                    level=level,
                    message=text,
                    values=[KeyValue(key=key, value=value) for key, value in values.items()],
                )
            )
        self.diagnostics.publish(message)

    def move(self, position: float) -> None:
        """Publish joint states with all joints at one position."""
        names = list(self.parameters.model.joint_names)
        self.joints.publish(JointState(name=names, position=[position] * len(names)))


@pytest.fixture
def live(domain) -> Iterator[tuple[Identifier, str]]:
    """An identifier, and the address of the page that shows it."""
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    identifier = Identifier(context)
    node = Node("web_monitor", context=context)
    values = {each.name: each.default for each in PARAMETERS}
    monitor = WebMonitor(node, values | {"model": str(MODEL), "port": 0})
    executor = MultiThreadedExecutor(2, context=context)
    executor.add_node(node)
    executor.add_node(identifier.node)
    stop = threading.Event()
    threads = [
        threading.Thread(target=executor.spin),
        threading.Thread(target=monitor.run, args=(stop,)),
    ]
    for thread in threads:
        thread.start()
    yield identifier, monitor._server.address
    stop.set()
    executor.shutdown()
    for thread in threads:
        thread.join()
    context.try_shutdown()


def test_the_page_follows_the_identifier(browser, live) -> None:
    identifier, address = live
    with browser.page(address, DESKTOP) as page:
        tab = page.tab
        tab.set_default_timeout(DEADLINE)
        assert "waiting" in tab.inner_text("#state")
        thigh = tab.locator(".mass[data-link=L_thigh]")
        for second in range(1, 5):
            identifier.publish(second, 5.0 + second / 10)
            thigh.get_by_text(f"{5.0 + second / 10:.2f} ±").wait_for()
        # Four estimates are four corners of the curve.
        assert thigh.locator(".line").get_attribute("d").count("L") == 3
        tab.locator("#alarms").get_by_text(ALARM).wait_for()
        tab.locator("#streams").get_by_text("/joint_states 1000 Hz").wait_for()
        tab.locator("#state").get_by_text("433 rows").wait_for()
        tab.wait_for_selector(".mass.changed[data-link=L_thigh]")
        assert not tab.locator("#followed").is_visible()
        identifier.publish(5, 5.4, change=FOLLOWED)
        tab.locator("#followed").get_by_text(FOLLOWED).wait_for()
        assert not tab.locator("#alarms").is_visible()
        # The 3D view shows the same estimate.
        tab.locator(".robot-view select").select_option(label="L_thigh")
        tab.locator(".robot-numbers").get_by_text("5.40 ±").wait_for()
        assert page.problems == page.overflow == []
        assert all(one.startswith(address.partition("?")[0]) for one in page.requests)


def test_the_robot_moves_with_its_joint_states(browser, live) -> None:
    identifier, address = live
    knee = "() => document.querySelector('.robot-view').robotView.links[3].group.position.toArray()"
    with browser.page(address) as page:
        page.tab.set_default_timeout(DEADLINE)
        before = page.tab.evaluate(knee)
        while page.tab.evaluate(knee) == before:
            identifier.move(0.4)
            page.tab.wait_for_timeout(50)


def test_a_page_that_is_opened_late_shows_the_history(browser, live) -> None:
    identifier, address = live
    with browser.page(address) as page:
        page.tab.set_default_timeout(DEADLINE)
        for second in (1, 2, 3):
            identifier.publish(second, float(second))
            page.tab.locator(".mass[data-link=L_thigh]").get_by_text(f"{second}.00 ±").wait_for()
    with browser.page(address, PHONE, dark=True) as page:
        page.tab.set_default_timeout(DEADLINE)
        page.tab.wait_for_selector(".mass[data-link=L_thigh] .line[d*=L]")
        line = page.tab.locator(".mass[data-link=L_thigh] .line").get_attribute("d")
        assert line.count("L") == 2
        assert page.problems == page.overflow == []


def test_buttons_call_the_identifier(browser, live) -> None:
    identifier, address = live
    with browser.page(address) as page:
        tab, thigh = page.tab, page.tab.locator(".mass[data-link=L_thigh]")
        tab.set_default_timeout(DEADLINE)
        identifier.publish(1, 5.0)
        thigh.get_by_text("5.00 ±").wait_for()
        tab.on("dialog", lambda dialog: dialog.accept())
        for name, answer in (
            ("solve", "solve done"),
            ("save", "parameter out: empty"),
            ("reset", "reset done"),
        ):
            tab.click(f"[data-action={name}]")
            tab.locator("#answer").get_by_text(answer).wait_for()
        assert identifier.calls == ["solve", "save", "reset"]
        # A reset also forgets what the page has shown.
        tab.wait_for_selector(".mass[data-link=L_thigh] .line:not([d])", state="attached")
        assert page.problems == []
