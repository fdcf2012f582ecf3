"""Depth images of the same poses: geomtact's caster against Open3D's ray casting and pyrender, and the casts alone."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from typing import Any

import numpy as np
from benchmark import spread
from peerbench.turns import Way, take_turns

BLOCK = 10  # poses rendered in turn
GRID = (24, 32)  # of the masks that an index holds
FIRST_SAMPLE = np.array([-0.125, 0.375])  # px off a pixel's centre: of its four samples, the one whose depth is read


def simulation(given: argparse.Namespace) -> list[dict[str, Any]]:
    from geomtact.contact_space.space import ContactSpace
    from geomtact.geometry.mesh_file import load_mesh
    from geomtact.sensing.cast import Caster
    from geomtact.sensing.sensor import Sensor

    sensor = Sensor.load(given.sensor)
    if not sensor.camera_distance or sensor.membrane_radius:
        sys.exit(f"sensor {sensor.name!r}: expected one with a camera and a flat gel, as pyrender sees; take gelslim")
    mesh = load_mesh(given.part, sensor=sensor)
    T, _ = ContactSpace(mesh, sensor).sample(given.poses + BLOCK, np.random.default_rng(given.seed))
    caster, rows, draw = Caster(mesh.vertices, mesh.faces, given.threads), [], None
    if find_spec("pyrender") and "PYOPENGL_PLATFORM" in os.environ:
        import pyrender

        draw = pyrender.OffscreenRenderer(*sensor.image_size_px)  # EGL allows one in a process
    for shape in (sensor.image_size_px[::-1], sensor.along(GRID)):
        rays = np.stack(np.meshgrid(*sensor.pixel_centres(shape)), -1).reshape(-1, 2)
        blocks = [T[i : i + BLOCK] for i in range(0, len(T), BLOCK)]
        ways = depth_ways(mesh, sensor, shape, caster, draw)
        take_turns(ways, ((block, *ready(*caster.rays(sensor, block, rays)[:2])) for block in blocks), compare)
        for way in ways:
            ms = spread([ms / BLOCK for ms in way.ms])
            row = {"threads": given.threads, "pixels": list(shape[::-1]), "faces": len(mesh.faces)}
            row |= {"method": way.method, "ms_per_image": ms, "rays_per_s": 1e3 * len(rays) / ms["median"]}
            if way.verdicts[0]:
                off = np.concatenate([verdict["um"] for verdict in way.verdicts])
                row |= {"median_um": float(np.median(off)), "largest_um": float(off.max())}
                row["over_1_um"] = float((off > 1).mean())
                for what in ("unlike_hits", "unlike_contact"):
                    row[what] = float(np.mean([verdict[what] for verdict in way.verdicts]))
            rows.append(row)
    return rows


def ready(origin: Any, direction: Any) -> tuple[Any, Any]:
    """Rays as embreex takes them, and as Open3D does."""
    import open3d as o3d

    return (origin, direction), o3d.core.Tensor(np.concatenate([origin, direction], 1))


def compare(own: Any, depths: Any) -> dict[str, Any]:
    """Differences (n,) [um] where both hit, and the shares of pixels in which one alone hits, or is in contact."""
    hit, theirs = np.isfinite(own), np.isfinite(depths)
    both = hit & theirs
    out = {"um": 1e6 * np.abs(own[both] - depths[both])}
    return out | {"unlike_hits": (hit != theirs).mean(), "unlike_contact": ((own > 0) != (depths > 0)).mean()}


def depth_ways(mesh: Any, sensor: Any, shape: tuple[int, int], caster: Any, draw: Any) -> list[Way]:
    """Variants from poses (n, 4, 4) to depths (n, h, w) [m], and the casts alone of rays that are there."""
    import open3d as o3d

    pool, distance, middle = ThreadPoolExecutor(caster.threads), sensor.camera_distance, caster.centre
    scene = o3d.t.geometry.RaycastingScene(nthreads=caster.threads)
    scene.add_triangles((mesh.vertices - middle).astype(np.float32), mesh.faces.astype(np.uint32))
    focal = distance * np.array(shape[::-1]) / (2 * sensor.half_window)
    K = np.array([[focal[0], 0, shape[1] / 2], [0, focal[1], shape[0] / 2], [0, 0, 1]])

    def views(T: Any) -> Any:
        """The object, its origin put at ``middle``, as a camera sees it that looks along z (n, 4, 4)."""
        seen = np.array(T, float)
        seen[:, :3, 3] += T[:, :3, :3] @ middle + [0, 0, distance]
        return seen

    def depths(T: Any, look: Callable[[Any], Any]) -> Any:
        out = np.empty((len(T), *shape), np.float32)
        for k, view in enumerate(views(T)):
            out[k] = distance - look(view)
        return out

    def cast(view: Any) -> Any:
        rays = scene.create_rays_pinhole(K, view, shape[1], shape[0])
        return scene.cast_rays(rays, nthreads=caster.threads)["t_hit"].numpy()

    def embree(item: Any) -> None:
        origin, direction = (np.array_split(each, caster.threads) for each in item[1])
        each = map if caster.threads == 1 else pool.map
        list(each(lambda o, d: caster.scene.distances(o, d), origin, direction))

    def open3d(item: Any) -> None:
        scene.cast_rays(item[2], nthreads=caster.threads)

    ways = [
        Way("geomtact", lambda item: caster.depths(sensor, item[0], shape)),
        Way("Open3D", lambda item: depths(item[0], cast)),
        Way("geomtact, cast alone", embree),
        Way("Open3D, cast alone", open3d),
    ]
    if draw is not None:
        look = drawn(mesh.vertices - middle, mesh.faces, sensor, K, draw, shape)
        ways.insert(2, Way("pyrender", lambda item: depths(item[0], look)))
    return ways


def drawn(vertices: Any, faces: Any, sensor: Any, K: Any, draw: Any, shape: tuple[int, int]) -> Callable[[Any], Any]:
    """From a view (4, 4) to pyrender's distances along z (h, w) [m], inf where nothing is."""
    import pyrender
    import trimesh

    from geomtact.se3 import inverse

    draw.viewport_height, draw.viewport_width = shape
    scene = pyrender.Scene()
    scene.add(pyrender.Mesh.from_trimesh(trimesh.Trimesh(vertices, faces, process=False)))
    near = sensor.camera_distance - 2 * sensor.max_penetration
    far = sensor.camera_distance + 2 * float(np.linalg.norm(vertices, axis=1).max())
    # it reads the depth of one sample of a pixel, which is brought to where the pixel's centre was
    camera = pyrender.IntrinsicsCamera(K[0, 0], K[1, 1], *(K[:2, 2] + FIRST_SAMPLE), znear=near, zfar=far)
    eye = scene.add(camera)

    def look(view: Any) -> Any:
        scene.set_pose(eye, inverse(view) @ np.diag([1.0, -1.0, -1.0, 1.0]))  # OpenGL looks along -z, y is up
        z = draw.render(scene, flags=pyrender.RenderFlags.DEPTH_ONLY)
        return np.where(z > 0, z, np.inf)

    return look
