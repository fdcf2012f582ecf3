"""The study ``samples``: the touches that posteriors are evaluated on."""

from __future__ import annotations

from geomtact.cli.options import Seed, Unit
from geomtact.cli.shell import print_table
from geomtact.cli.simulate import NoiseName
from tools.studies.common import study_options


def judge_samples(
    parts: study_options.Parts,
    unit: Unit = None,
    sensor: study_options.SensorName = "gelslim",
    touches: study_options.Touches = 200,
    noise: study_options.NoiseLevel = NoiseName.moderate,
    seed: Seed = 1,
) -> None:
    """Describe the touches that posteriors are judged on: how deep, how large, how many run over the window's border.

    Prints a table, half of the touches by a rigid threshold and half by an elastic gel, and writes nothing.
    """
    import numpy as np

    from geomtact.contact_space.space import ContactSpace
    from geomtact.sensing.sensor import Sensor
    from tools.studies.common.study import make_touches
    from tools.studies.stability.worlds import cut_off

    pressed, strength = Sensor.load(sensor), study_options.noise_named(noise)
    pixel_mm2 = 1e6 * float(np.prod(pressed.pixel_pitch))
    rows = []
    for mesh in study_options.meshes(parts, unit, pressed):
        made = make_touches(ContactSpace(mesh, pressed), touches, seed, strength)
        for name, elastic in (("geometric", False), ("elastic", True)):
            some = [t for t in made if t.elastic == elastic]
            if not some:
                continue
            areas = np.quantile([t.mask.sum() * pixel_mm2 for t in some], (0.1, 0.5, 0.9))
            border = np.mean([cut_off(t.mask) > 0 for t in some])
            depth = np.median([1e3 * t.penetration for t in some])
            row = [f"{depth:.2f}", *(f"{a:.1f}" for a in areas), f"{100 * border:.0f} %"]
            rows.append([mesh.name, name, str(len(some)), *row])
    headings = ("part", "touches", "n", "depth [mm]", "area [mm2]: 10 %", "50 %", "90 %", "over the border")
    print_table(headings, rows, headings[2:])
