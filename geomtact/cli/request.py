"""What a command is asked for: command line, geomtact.toml and image metadata resolved, and the localizer for that."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from geomtact.cli.options import Effort, Kind, Mounting, check_name
from geomtact.cli.project import required, resolve
from geomtact.cli.shell import posterior_file, progress_bar, to_stderr

if TYPE_CHECKING:
    from geomtact.geometry.approach import Approach
    from geomtact.geometry.mesh import Mesh
    from geomtact.localizer import Localizer
    from geomtact.sensing.sensor import Sensor

_MANY_WINDOWS = 10  # long sides of the window, from which on an object's unit is doubted


@dataclass(frozen=True)
class Request:
    """Resolved options of a command.

    Attributes
    ----------
    values : object, unit, sensor, background and effort; None where none is given
    sources : where those values come from that the command line did not give
    kind : of the images, as of ``localize``
    prior : file of a saved posterior
    approach : as of ``Localizer.prepare``
    """

    values: dict[str, str | None]
    sources: dict[str, str]
    kind: str = Kind.auto.value
    prior: Path | None = None
    approach: Approach | None = None
    scorer: str | None = None
    seed: int = 0
    max_poses: int | None = None
    cache_dir: Path | None = None
    mounting: Mounting = field(default_factory=Mounting)

    @classmethod
    def of(
        cls,
        given: Mapping[str, str | Path | None],
        metadata: Mapping[str, str],
        kind: str,
        prior: Path | None = None,
        **rest: Any,
    ) -> Request:
        """The request for the options that are ``given`` by name; ``metadata`` of the first image; ``rest`` are attributes.

        Raises
        ------
        UsageError, InputError
            An unknown kind or effort, or a prior that is no posterior.
        """
        prior = prior and posterior_file(prior, "--prior")
        texts = {name: None if value is None else str(value) for name, value in given.items()}
        values, sources = resolve(texts, metadata)
        values["effort"] = effort = values["effort"] or Effort.balanced.value
        check_name("kind", kind, Kind)
        check_name("effort", effort, Effort, sources.get("effort"))
        return cls(values, sources, kind, prior, **rest)

    @property
    def effort(self) -> str:
        """The effort, balanced where none is given."""
        return self.values["effort"] or Effort.balanced.value

    def announce(self) -> None:
        """Print where values come from that the command line did not give."""
        for key, source in self.sources.items():
            to_stderr(f"{key}: {self.values[key]} (from {source})")

    def mounted(self, sensor: str | None = None) -> Sensor | None:
        """``sensor``, else the one asked for, mounted as the command line says; None where none is given."""
        name = sensor or self.values["sensor"]
        return self.mounting.of(name) if name else None

    def open(
        self,
        own: Mapping[str, str | None] | None = None,
        frame: str = "sensor",
        argument: str | None = None,
        announce: bool = True,
    ) -> Localizer:
        """The localizer, with a progress bar where its index has to be built first.

        A prior of another object, or not in ``frame``, is refused before that.

        Parameters
        ----------
        own : values for one of several objects or sensors, instead of the resolved ones
        argument : how the command line names the object, if not by --object
        announce : print where values come from that the command line did not give

        Raises
        ------
        UsageError
            The object or the sensor is missing.
        InputError, MeshError, SensorError
        """
        values = {**self.values, **(own or {})}
        object_name, sensor = required(values, argument)
        if announce:
            self.announce()

        from geomtact.contact_space.resolution import MAX_POSES
        from geomtact.geometry.mesh_file import load_mesh
        from geomtact.inference.files import heading
        from geomtact.inference.prior import check_same
        from geomtact.localizer import Localizer
        from geomtact.scoring.catalogue import DEFAULT_SCORER, check_name

        scorer = self.scorer or DEFAULT_SCORER
        check_name(scorer)  # before minutes go into an index
        gel = self.mounting.of(sensor)
        mesh = load_mesh(object_name, values["unit"], sensor=gel)
        if self.prior is not None:
            check_same(heading(self.prior), mesh, frame)
        warn_of_size(mesh, gel)
        size, folder = self.max_poses or MAX_POSES, self.cache_dir
        with progress_bar("preparing") as bar:
            return Localizer.prepare(
                mesh, None, gel, self.approach, scorer=scorer, max_poses=size, cache_dir=folder, progress=bar
            )


def warn_of_size(mesh: Mesh, sensor: Sensor) -> None:
    """Warn of an object so large that its unit may be wrong."""
    windows = mesh.diameter / (2 * sensor.half_window.max())
    if windows > _MANY_WINDOWS:
        to_stderr(
            f"warning: read in {mesh.unit}, {mesh.name} is {1e3 * mesh.diameter:.0f} mm across, {windows:.0f} windows of "
            f"sensor {sensor.name!r}; if its size is another, give its --unit; so large an object takes long to prepare"
        )
