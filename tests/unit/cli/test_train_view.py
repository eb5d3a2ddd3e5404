"""What a person sees of a training run."""

from __future__ import annotations

import io

import pytest

from phase_sumo.cli.train_view import COURSE, Course, Progress, Row, Screen, line, train_view

ROW: Row = {
    "steps": 0,
    "goal_rate": 0.5,
    "collision_rate": 0.125,
    "road_edge_rate": 0.01,
    "rho": 0.4,
    "prior_kl": 0.1234,
    "learning_rate": 7.3e-4,
    "peak_memory_mb": 812.3,
    "peak_gpu_memory_mb": 12_345.6,
}
HELD_OUT: Row = {
    "held_out_goal_rate": 1.0,
    "held_out_agent_collision_rate": 0.25,
    "held_out_road_collision_rate": 0.05,
    "held_out_success_rate": 1.0,
}


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_speed_and_time_left_are_those_of_late():
    clock = Clock()
    progress = Progress(1_000_000, 3_000_000, clock)
    assert progress.left == "-:--:--"
    for update in range(1, 101):
        clock.now += 10.0 if update <= 50 else 5.0
        progress.add(ROW | {"steps": 1_000_000 + 10_000 * update})
    assert progress.speed == pytest.approx(2000.0) and progress.left == "0:08:20"
    clock.now += 20.0
    assert progress.left == "0:08:00"
    assert "67% 2.00 M steps  0:08:00 left  2,000 steps/s  goal 50.0%" in line(progress)


def test_the_screen_fits_a_small_terminal():
    from rich.console import Console

    clock = Clock()
    screen = Screen("runs/" + 100 * "long", 2_900_000_000, 3_000_000_000, lambda: False, clock)

    def drawn() -> list[str]:
        file = io.StringIO()
        Console(file=file, width=80, height=24).print(screen.draw())
        shown = file.getvalue().splitlines()
        assert len(shown) <= 12 and all(len(line) == 80 for line in shown)
        return shown

    assert "the first update" in drawn()[2]
    for update in range(1, 100):
        clock.now += 1.0
        screen.add(ROW | HELD_OUT | {"steps": 2_900_000_000 + 1_000_000 * update})
        drawn()
    text = "\n".join(drawn())
    for words in ("goal", "50.0%", "off road", "rho", "0.123", "7.3e-04", "812 MB", "12,346 MB", "Ctrl-C"):
        assert words in text
    assert "1,000,000 steps/s" in text and "0:01:39 0:00:01 left" in text
    assert "held out at 2999.00 M:  goal 100%  collision 25%  off road 5%  success 100%" in text


def test_a_course_is_short_and_keeps_its_shape():
    course = Course()
    assert str(course) == ""
    for value in range(1000):
        course.add(float(value))
    assert COURSE // 2 <= len(str(course)) <= COURSE
    assert list(str(course)) == sorted(str(course)) and str(course)[-1] == "█"


def test_without_a_terminal_there_are_lines_now_and_then(monkeypatch, capsys):
    def lines_of(every: float) -> list[str]:
        monkeypatch.setattr("phase_sumo.cli.train_view.LINE_EVERY", every)
        with train_view("run", 0, 100_000, lambda: False) as show:
            for update in range(1, 6):
                show(ROW | (HELD_OUT if update == 4 else {}) | {"steps": 10_000 * update})
        return capsys.readouterr().err.splitlines()

    assert len(lines_of(0.0)) == 5
    seldom = lines_of(1000.0)
    assert len(seldom) == 2 and "held out: goal 100.0%" in seldom[1]
