"""Commands of ``uuv`` about real vehicles and their autopilots (``cli.py`` has the others)."""

from __future__ import annotations

import typer

from uuvtai import option_groups as groups
from uuvtai import options as opt
from uuvtai.endings import GATE, say


def add_to(app: typer.Typer) -> None:
    """Give the program these commands."""
    app.command(
        "pilot", epilog="Example: uuv pilot --mavlink udp:127.0.0.1:14550 --start 2,3,-0.8 --goal 18,3,-0.8"
    )(pilot_vehicle)
    app.command("sitl", epilog="Example: uuv sitl --world pool -S 8 -D 6 -v 0.6 --instances 3")(serve_sitl)


@groups.grouped
def pilot_vehicle(
    *,
    flight: groups.FlightGroup,
    scene: groups.SeenSceneGroup,
    output: groups.OutputGroup,
    controller: opt.PilotTree = "bt",
) -> None:
    """Drive a real vehicle, or ArduSub's simulated one, by MAVLink; a dry run unless --arm is typed
    (docs/safety.md). Exit code 3: it ended by a safe action."""
    from uuvtai.link.onboard_loop import fly
    from uuvtai.show.flights import show_flight
    from uuvtai.tree import read_tree

    config = scene.config()
    found = fly(config, read_tree(controller, config.teacher.max_node), flight.plan(config), say)
    output.show(found, lambda screen: show_flight(screen, found))
    if not found["safe"]:
        raise typer.Exit(GATE)


@groups.grouped
def serve_sitl(
    *, scene: groups.SitlSceneGroup, served: groups.ServedGroup, output: groups.OutputGroup
) -> None:
    """Be the water for ArduSub: our physics, world and sensors behind its JSON interface (docs/sitl.md)."""
    from uuvtai.show.flights import show_sitl
    from uuvtai.sitl.serving import serve_water
    from uuvtai.tree import read_tree

    plan, config = served.plan(), scene.config()
    found = serve_water(config, read_tree("straight", config.teacher.max_node), plan, say)
    output.show(found, lambda screen: show_sitl(screen, found))
