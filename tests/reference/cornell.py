"""Makes the tables here: path-traced irradiance at 256 floor and wall points of the Cornell rooms.

    python cornell.py              empty-grey.csv and the others, 5 minutes on two cores
    python cornell.py furnace      all glows, half is reflected: 2 everywhere, to 0.1 %

Needs mitsuba 3.9, numpy and LLVM 16 or newer, which DRJIT_LIBLLVM_PATH may name. Shapes and paints
are those of `pvmap scene empty` and `furnished`, from pipeline/scene/src/rooms.rs.
"""

import sys
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")
PASSES, STRATA, SIDE, GAP = 64, 64, 5.5, 0.11
LAMP, EXITANCE = (2.1, 2.225, 3.4, 3.275), 10.0  # x0, y0, x1, y1 on the ceiling
CENTRE, RADIUS = np.array([3.9, 1.8, 0.9]), 0.9
FOOT, HALF, HEIGHT, COS, SIN = np.array([1.9, 3.6]), 0.8, 3.2, 24 / 25, 7 / 25
PAINTS = {"white": (222, 218, 208), "red": (186, 38, 32), "green": (42, 150, 58),
          "pink": (236, 152, 170), "blue": (92, 128, 200)}
# Floor and walls: corner, two sides (u x v points into the room), paint.
SURFACES = [((0, 0, 0), (SIDE, 0, 0), (0, SIDE, 0), "white"),
            ((0, 0, 0), (0, SIDE, 0), (0, 0, SIDE), "red"),
            ((SIDE, SIDE, 0), (0, -SIDE, 0), (0, 0, SIDE), "green"),
            ((0, SIDE, 0), (SIDE, 0, 0), (0, 0, SIDE), "white"),
            ((SIDE, 0, 0), (-SIDE, 0, 0), (0, 0, SIDE), "white")]
# What is computed: scene, furnished or not, albedo (None: as painted).
CASES = [("empty-grey", False, 0.7), ("furnished-grey", True, 0.7), ("furnished-scan", True, None)]


def albedo(paint, grey):
    """What a paint reflects: a constant, or its sRGB value in linear light."""
    c = np.array(PAINTS[paint]) / 255
    return [grey] * 3 if grey else np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def shape(kind, rho, exitance, **form):
    color = lambda value: {"type": "rgb", "value": [float(v) for v in value]}
    made = {"type": kind, "bsdf": {"type": "diffuse", "reflectance": color(rho)}, **form}
    if exitance > 0:
        made["emitter"] = {"type": "area", "radiance": color([exitance / np.pi] * 3)}
    return made


def rectangle(corner, u, v, rho, exitance):
    """A rectangle whose front is where u x v points."""
    corner, u, v = (np.array(a, float) for a in (corner, u, v))
    n = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    columns = np.array([u / 2, v / 2, n, corner + u / 2 + v / 2]).T
    to_world = mi.ScalarTransform4f(np.vstack([columns, [0, 0, 0, 1]]))
    return shape("rectangle", rho, exitance, to_world=to_world)


def room(is_furnished, grey, all_glow=0.0):
    """The scene; with `all_glow` all surfaces have that exitance, the lamp among them."""
    shapes = [rectangle(c, u, v, albedo(p, grey), all_glow) for c, u, v, p in SURFACES]
    x0, y0, x1, y1 = LAMP
    plates = [((0, 0), (SIDE, y0)), ((0, y1), (SIDE, SIDE)), ((0, y0), (x0, y1)),
              ((x1, y0), (SIDE, y1)), ((x0, y0), (x1, y1))]
    for a, b in plates:
        glow = all_glow or (EXITANCE if a == (x0, y0) else 0.0)
        sides = (0, b[1] - a[1], 0), (b[0] - a[0], 0, 0)
        shapes.append(rectangle((*a, SIDE), *sides, albedo("white", grey), glow))
    if is_furnished:
        matrix = [[HALF * COS, -HALF * SIN, 0, FOOT[0]], [HALF * SIN, HALF * COS, 0, FOOT[1]],
                  [0, 0, HEIGHT / 2, HEIGHT / 2], [0, 0, 0, 1]]
        to_world = mi.ScalarTransform4f(matrix)
        shapes.append(shape("cube", albedo("blue", grey), all_glow, to_world=to_world))
        ball = {"center": CENTRE.tolist(), "radius": RADIUS}
        shapes.append(shape("sphere", albedo("pink", grey), all_glow, **ball))
    return mi.load_dict({"type": "scene", **{f"s{i}": s for i, s in enumerate(shapes)}})


def is_free(p):
    """Whether a place keeps GAP from the edges of its surface, from the box and the sphere."""
    out = np.abs(np.array([[COS, SIN], [-SIN, COS]]) @ (p[:2] - FOOT)) - HALF
    from_box = np.linalg.norm(np.maximum([*out, p[2] - HEIGHT], 0))
    from_sphere = np.linalg.norm(p - CENTRE) - RADIUS
    return np.sum((p < GAP) | (p > SIDE - GAP)) < 2 and min(from_box, from_sphere) >= GAP


def places():
    """Draws places and their normals: 64 of the floor and 48 of each wall, one a cell of a grid."""
    rng = np.random.default_rng(2007)
    for corner, u, v, _ in SURFACES:
        corner, u, v = (np.array(a, float) for a in (corner, u, v))
        columns, rows = 8, 6 if v[2] else 8
        for cell in range(rows * columns):
            p, attempt = corner, 0
            while not is_free(p):
                # Where a cell is all under the box any other one takes its place.
                if attempt == 100:
                    cell, attempt = rng.integers(rows * columns), 0
                row, column = divmod(cell, columns)
                s, t = (column + rng.random()) / columns, (row + rng.random()) / rows
                p, attempt = np.round(corner + s * u + t * v, 4), attempt + 1
            yield p, np.cross(u, v) / SIDE**2


def passes(scene, drawn):
    """Gives, a pass, the irradiance of places: what glows, by places drawn on it; the same by
    directions; and what is reflected. Arrays of places x 3 channels."""
    n = STRATA * STRATA
    p, normal = (np.repeat(np.array(a, np.float32).T, n, axis=1) for a in zip(*drawn))
    at = scene.ray_intersect(mi.Ray3f(mi.Point3f(p + normal * 0.05), mi.Vector3f(-normal)))
    i = mi.UInt(np.tile(np.arange(n, dtype=np.uint32), len(drawn)))
    cell = mi.Point2f(mi.Float(i % STRATA), mi.Float(i // STRATA))
    plugins = {"type": "path", "max_depth": -1, "rr_depth": 12}, {"type": "independent"}
    path, sampler = (mi.load_dict(plugin) for plugin in plugins)
    mean = lambda light: np.array(light).T.reshape(len(drawn), n, 3).astype(float).mean(axis=1)
    for seed in range(PASSES):
        sampler.seed(seed, len(drawn) * n)
        one, other = ((cell + sampler.next_2d()) / STRATA for _ in range(2))
        to, light = scene.sample_emitter_direction(at, one, test_visibility=True)
        ray = at.spawn_ray(at.to_world(mi.warp.square_to_cosine_hemisphere(other)))
        radiance = path.sample(scene, sampler, mi.RayDifferential3f(ray))[0]
        first = scene.ray_intersect(ray)
        glow = first.emitter(scene).eval(first)
        yield mean(light * at.to_local(to.d).z), np.pi * mean(glow), np.pi * mean(radiance - glow)


def head(name, grey):
    """What stands over the rows of a table."""
    yield f"""\
# Irradiance at 256 floor and wall points of the Cornell room of `pvmap scene {name.split("-")[0]}`:
# path-traced by cornell.py with Mitsuba {mi.__version__} (llvm_ad_rgb, paths of any length), \
{PASSES * STRATA**2} paths a
# point, stratified. All is Lambertian. The ceiling glows with exitance {EXITANCE:g} in x0, y0, x1, y1 =
# {LAMP} and reflects there as elsewhere. Points keep {GAP} m from other surfaces.
# direct: the part straight from the lamp. error: standard error by the spread of {PASSES} passes, a share
# of the value; the largest of the three channels."""
    if grey:
        yield f"# Albedo: {grey} everywhere."
    else:
        yield "# Albedo: the linear light (red, green, blue) of the scan's sRGB colours:"
        yield from (" ".join(["#  ", paint, *(f"{c:.6f}" for c in albedo(paint, None))])
                    for paint in PAINTS)
    yield "x,y,z,nx,ny,nz,direct,red,green,blue,error"


def tables():
    drawn = list(places())
    for name, is_furnished, grey in CASES:
        parts = passes(room(is_furnished, grey), drawn)
        found = np.array([(direct, direct + reflected) for direct, _, reflected in parts])
        direct, light = found.mean(axis=0)
        errors = (found[:, 1].std(axis=0, ddof=1) / PASSES**0.5 / light).max(axis=1)
        with open(f"{name}.csv", "w") as table:
            print(*head(name, grey), sep="\n", file=table)
            for (p, n), d, rgb, error in zip(drawn, direct[:, 0], light, errors):
                numbers = (f"{v:.6g}" for v in [*p, *n, d, *rgb])
                print(*numbers, f"{error:.5f}", sep=",", file=table)


if sys.argv[1:] == ["furnace"]:
    found = passes(room(True, 0.5, 1.0), list(places()))
    h = np.mean([glow + reflected for _, glow, reflected in found], axis=0)
    print(f"mean {h.mean():.6f}, least {h.min():.6f}, most {h.max():.6f}")
else:
    tables()
