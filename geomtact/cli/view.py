"""``geomtact view``: an object tracked through a sequence of images, shown live in the browser."""

from __future__ import annotations

import time
from typing import Annotated

import typer

from geomtact.cli import options
from geomtact.cli.shell import to_stderr
from geomtact.cli.track import exit_untouched, open_track


def view(
    source: options.Source,
    object_name: options.ObjectName = None,
    unit: options.Unit = None,
    sensor: options.SensorName = None,
    kind: options.KindName = options.Kind.auto.value,
    background: options.Background = None,
    effort: options.EffortName = None,
    scorer: options.ScorerName = None,
    motion_mm: options.MotionMm = options.MOTION_MM,
    follow: options.Follow = False,
    skip_broken: options.SkipBroken = False,
    rotate: options.Rotate = None,
    mirror: options.Mirror = None,
    host: Annotated[str, typer.Option(help="Address of the page; 0.0.0.0 serves it to other machines.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port; if it is taken, the next free one.")] = 8080,
    stay: Annotated[bool, typer.Option(help="Serve the page after the last image, until Ctrl-C.")] = True,
    seed: options.Seed = 0,
    max_poses: options.MaxPoses = None,
    cache_dir: options.CacheDir = None,
) -> None:
    """Track an object as 'geomtact track' does, and show its pose distribution live in the browser.

    The page shows the sensor, the contact and the object at its most probable pose. Faint copies show poses drawn
    from the posterior. Needs viser: pip install 'geomtact\\[viz]'. Exit status as of 'geomtact track'.
    """
    from geomtact.report.viewer import Viewer, check_viewer

    check_viewer(host)  # before minutes go into an index
    localizer, posteriors = open_track(
        source,
        follow,
        skip_broken,
        motion_mm,
        {"object": object_name, "unit": unit, "sensor": sensor, "background": background, "effort": effort},
        kind=kind,
        scorer=scorer,
        seed=seed,
        max_poses=max_poses,
        cache_dir=cache_dir,
        mounting=options.Mounting(rotate, mirror),
    )

    viewer, touched = Viewer(localizer.mesh, host, port), False
    typer.echo(viewer.url)
    try:
        for n, (_, posterior) in enumerate(posteriors, 1):
            viewer.show(n, posterior)
            touched |= posterior.contact
        if stay:
            to_stderr("all images shown; press Ctrl-C to stop serving the page")
        while stay:
            time.sleep(1)
    except KeyboardInterrupt:
        to_stderr("stopped")
    finally:
        viewer.stop()
    exit_untouched(touched)
