"""A forked child cannot step its parent's simulator: the threads stayed with the parent."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable

import pytest

from dexctl import SimulationError
from dexctl.sim import BatchSimulator, GroupedSimulator, Scene

pytestmark = pytest.mark.skipif(
    "fork" not in multiprocessing.get_all_start_methods(), reason="this system does not fork"
)


@pytest.fixture(scope="module")
def cylinder(dex5) -> Scene:
    return Scene.build(dex5, "cylinder")


def in_a_fork(work: Callable[[], None]) -> str:
    """What came of ``work`` in a forked child; "hangs" after 20 s."""
    context = multiprocessing.get_context("fork")
    receive, send = context.Pipe(duplex=False)

    def run() -> None:
        try:
            work()
        except SimulationError as error:
            send.send(str(error))
        else:
            send.send("done")

    child = context.Process(target=run, daemon=True)
    child.start()
    try:
        return receive.recv() if receive.poll(20.0) else "hangs"
    finally:
        child.join(5.0)
        if child.is_alive():
            child.kill()
            child.join()


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.parametrize("grouped", [False, True])
def test_a_forked_child_is_told(cylinder: Scene, grouped: bool) -> None:
    sim = (
        GroupedSimulator([(cylinder, 2), (cylinder, 2)], threads=2)
        if grouped
        else BatchSimulator(cylinder, 4, threads=2)
    )
    with sim:
        sim.step()
        said = in_a_fork(sim.step)
        assert "is a fork; make a simulator here" in said and "\n" not in said
        state = sim.read()
        grasp = state.q, state.q_target, state.object_position, state.object_quaternion
        assert "is a fork" in in_a_fork(lambda: sim.set_grasp(*grasp))  # type: ignore[arg-type]
        assert in_a_fork(sim.close) == "done"
        sim.step()  # the parent's goes on


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_without_threads_a_child_may_step(cylinder: Scene) -> None:
    with BatchSimulator(cylinder, 2, threads=1) as sim:
        sim.step()
        assert in_a_fork(sim.step) == "done"


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_child_may_have_a_simulator_of_its_own(cylinder: Scene) -> None:
    def own() -> None:
        with BatchSimulator(cylinder, 4, threads=2) as sim:
            sim.step()

    with BatchSimulator(cylinder, 4, threads=2) as sim:
        sim.step()
        assert in_a_fork(own) == "done"
