"""Keys and policy of a fleet of robots, and the verbs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tutelage import cli
from tutelage.errors import ConfigError
from tutelage.remote.robot import RobotConfig
from tutelage.remote.setup import new_fleet
from tutelage.remote.topics import alias, cameras_in, fleet_policy, robots_in
from tutelage.sgc.home import Home
from tutelage.sgc.policy import Policy


def test_the_policy_gives_each_robot_its_own_topics_and_the_server_all() -> None:
    policy = Policy.parse(fleet_policy(["arm-1", "arm-2", "arm-10"], "office", ["front", "wrist"]))
    assert robots_in(set(policy.of_node("office"))) == ("arm-1", "arm-2", "arm-10")
    own = set(policy.of_node("arm-2"))
    assert robots_in(own) == ("arm-2",)
    assert cameras_in("arm-2", own) == ("front", "wrist")
    assert not any("arm-1" in name for name in own)
    command = policy.topics[alias("arm-1", "command")]
    assert command.may_send("office")
    assert not command.may_send("arm-1")
    assert not command.may_send("arm-2")
    assert command.authenticity == "session"
    stop = policy.topics[alias("arm-1", "stop")]
    assert (stop.authenticity, stop.delivery) == ("signature", "reliable")


@pytest.mark.parametrize("robots", [[], ["a", "a"], ["server"], ["x" * 31], ["fleet"], ["no space"]])
def test_impossible_fleets_are_refused(robots: list[str]) -> None:
    with pytest.raises(ConfigError):
        Policy.parse(fleet_policy(robots))


def test_one_call_makes_a_fleet_whose_nodes_know_their_part(tmp_path: Path) -> None:
    made = new_fleet(tmp_path, ["left", "right"], server="office")
    assert [path.name for path in made.robots] == ["left", "right"]
    server = Home.open(made.server)
    assert robots_in(set(server.access.topics)) == ("left", "right")
    assert (made.server / "network.toml").read_text().count("tls/127.0.0.1:7447") == 1
    assert not (made.router / "network.toml").exists()


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"hz": 0.0}, "rates are 0.1 to 1000 Hz"),
        ({"watchdog": 0.0}, "watchdog needs"),
        ({"hz": 2.0}, "no command could be in time"),
        ({"slew": -1.0}, "must be more than 0"),
        ({"quality": 0}, "quality"),
    ],
)
def test_a_robot_that_could_not_work_is_refused(settings: dict[str, float], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        RobotConfig(**settings)  # type: ignore[arg-type]


def test_the_verbs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "fleet"
    cli.main(["fleet", "new", str(folder), "--robots", "2", "--connect", "tls/127.0.0.1:9"])
    assert f"tutelage robot {folder / 'robot-1'} --env Navigation" in capsys.readouterr().out
    cli.main(["fleet", "policy", "arm-1", "--server", "office"])
    assert Policy.parse(capsys.readouterr().out).topics["arm-1.stop"].may_send("office")
    for words, says in (
        (["fleet", "new", str(folder)], "is not empty; choose another folder"),
        (["fleet", "new", str(tmp_path / "b"), "--robots", "0"], "1 to 10,000 robots"),
        (["robot", str(tmp_path / "nowhere"), "--env", "Navigation"], "no node's home"),
        (["robot", str(folder / "robot-1"), "--env", "Nothing"], "unknown task 'Nothing'"),
        (["robot", str(folder / "server"), "--env", "Navigation"], "the policy has no robot server"),
        (["fleet", "status", str(folder / "server"), "--seconds", "0.1"], "no robot of robot-1, robot-2 answered"),
    ):
        with pytest.raises(SystemExit) as end:
            cli.main(words)
        assert end.value.code == 2
        assert says in capsys.readouterr().err


def test_a_robot_starts_without_the_learning_libraries(tmp_path: Path) -> None:
    code = "import sys; from tutelage.remote.driver import make_driver; import tutelage.remote.robot; "
    code += "make_driver('Navigation'); sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
