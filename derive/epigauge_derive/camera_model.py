"""A camera as data: unknowns, projection and update; every kernel of it follows from these.

A camera maps a point X of space to h in its own frame, linearly, and h to the image by a formula
with parameters k. `Frame` states the first and how an update of the camera moves what it sees;
`CameraModel` the second. Both Jacobians, the update and the gauge are derived from them.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import sympy as sp

from epigauge_derive.gauge import generator_kernels
from epigauge_derive.kernel import Input, Kernel, Let, Loop, Output, at, cross, jacobian

#: The camera frame; u and v stand for h0/h2 and h1/h2 where the image depends on these alone.
H = Input("h", (3,))
_U, _V, _INVERSE_DEPTH = sp.symbols("u v inverse_depth", real=True)
MEASURED = Input("q", (2,))
#: The measured point whose correction is an image: Newton steps lead to it from the image.
_FOUND = sp.symbols("x_found y_found", real=True)
_NEWTON = 8

Vector = Sequence[sp.Expr]


@dataclass(frozen=True, eq=False)
class Frame:
    """How a camera sees space, h = M X with a 3x4 matrix M, and how it moves.

    Attributes
    ----------
    entries : tuple of str
        Names of the entries of M, row by row.
    unknowns : mapping of str to str
        Names and units of an update delta.
    point_size : int
        3 for points (X, 1), 4 for homogeneous points.
    act : callable
        ``act(h, X, delta)``: what the updated camera sees; linear in h and X together.
    seen : callable
        ``seen(M, B)``: the 3x4 field that the camera sees if points move by B X, on the vector
        that `act` multiplies its update with: (h, 1) for a pose, X for a matrix.
    even : callable
        Functions of delta that `act` names, without first derivative at zero: symbol to formula
        and value at zero.
    relations : tuple of Expr
        Polynomials of the entries of M that are zero; none where any matrix is a camera. With them
        M is a rotation and a translation.
    """

    entries: tuple[str, ...]
    unknowns: Mapping[str, str]
    point_size: int
    act: Callable[[sp.Matrix, sp.Matrix, Vector], sp.Matrix]
    seen: Callable[[sp.Matrix, sp.Matrix], sp.Matrix]
    even: Callable[[Vector], dict[sp.Symbol, tuple[sp.Expr, sp.Expr]]] = lambda delta: {}
    relations: tuple[sp.Expr, ...] = ()

    def moved(self, M: sp.Matrix, delta: Vector) -> sp.Matrix:
        """Return the matrix of the updated camera."""
        h, X = H.entries(), sp.symbols("X0:4", real=True)
        seen = list(self.act(sp.Matrix(h), sp.Matrix(X), delta))
        return jacobian(seen, h) * M + jacobian(seen, X)

    def velocities(self, h: sp.Matrix, X: sp.Matrix) -> sp.Matrix:
        """Return the derivative of what is seen by the update, at zero."""
        delta = sp.symbols(f"delta0:{len(self.unknowns)}", real=True)
        zero = {symbol: value for symbol, (_, value) in self.even(delta).items()}
        seen = list(self.act(h, X, delta))
        return at(at(jacobian(seen, delta), dict.fromkeys(delta, sp.S.Zero)), zero)


_HALF_SINE, _HALF_COSINE = sp.symbols("half_sine half_cosine", real=True)
#: Keeps sin(a / 2) / a from 0 / 0; too small to change it for any other a.
_TINY = sp.Float("1e-40")


def _turn(h: sp.Matrix, X: sp.Matrix, delta: Vector) -> sp.Matrix:
    """Return exp(w) (h - move X3).

    With s = sin(a/2)/a, c = cos(a/2) and a = |w|: exp(w) = I + 2 s c [w] + 2 s^2 [w]^2, which loses
    no digit for small a.
    """
    w, move = delta[:3], sp.Matrix(delta[3:])
    W, s, c = cross(w), _HALF_SINE, _HALF_COSINE
    return (sp.eye(3) + 2 * s * c * W + 2 * s**2 * W * W) * (h - move * X[3])


def _half_angle(delta: Vector) -> dict[sp.Symbol, tuple[sp.Expr, sp.Expr]]:
    angle = sp.sqrt(sum(w**2 for w in delta[:3]) + _TINY)
    return {
        _HALF_SINE: (sp.sin(angle / 2) / angle, sp.S.Half),
        _HALF_COSINE: (sp.cos(angle / 2), sp.S.One),
    }


def _carried(M: sp.Matrix, B: sp.Matrix) -> sp.Matrix:
    """Return M B (M; 0 0 0 1)^-1 of a rigid M."""
    R, t = M[:, :3], M[:, 3]
    inverse = R.T.row_join(-R.T * t).col_join(sp.Matrix([[0, 0, 0, 1]]))
    return M * B * inverse


_POSE = tuple(f"R{i}{j}" if j < 3 else "t" + "xyz"[i] for i in range(3) for j in range(4))


def _rotation() -> tuple[sp.Expr, ...]:
    """Return what the entries of a rotation obey."""
    R = sp.Matrix(3, 4, [sp.Symbol(name, real=True) for name in _POSE])[:, :3]
    relations = [*(R * R.T - sp.eye(3)), *(R.T * R - sp.eye(3)), *(R.cofactor_matrix() - R)]
    return tuple(dict.fromkeys(map(sp.expand, relations)))


#: A pose, x_cam = R X + t. The update turns and moves the camera in its own frame about its own
#: centre, so that a similarity of space acts on it by diag(1, s, 1) (math: equivariant update).
POSE = Frame(
    entries=_POSE,
    unknowns={"wx": "rad", "wy": "rad", "wz": "rad", "dx": "scene", "dy": "scene", "dz": "scene"},
    point_size=3,
    act=_turn,
    seen=_carried,
    even=_half_angle,
    relations=_rotation(),
)


@dataclass(frozen=True, eq=False)
class CameraModel:
    """A camera model.

    Attributes
    ----------
    name : str
        Name that users write; in lower case it is the prefix of the kernels.
    title : str
        What camera it is, in one sentence.
    parameters : mapping of str to str
        Names of the intrinsic parameters in order, with their units.
    image : callable
        ``image(h, k)``: the image point of h in the camera frame.
    frame : Frame
        How the camera sees space.
    depth : callable
        ``depth(h)``: positive in front of the camera.
    constants : tuple of str
        The last parameters, if they are given once and never adjusted: they have no unknown.
    wrap : callable
        ``wrap(r, k)``: brings a residual to the nearest period, where the image has one.
    aliases : tuple of str
        Other names of the same model.
    correct : callable
        ``correct(q, k)``: what of a measured point q is compared with the image, for a lens that is
        corrected on the side of the measurements; else q itself.
    """

    name: str
    title: str
    parameters: Mapping[str, str]
    image: Callable[[sp.Matrix, Vector], Sequence[sp.Expr]]
    frame: Frame = POSE
    depth: Callable[[sp.Matrix], sp.Expr] = lambda h: h[2]
    constants: tuple[str, ...] = ()
    wrap: Callable[[Sequence[sp.Expr], Vector], Sequence[sp.Expr]] = lambda r, k: r
    aliases: tuple[str, ...] = ()
    correct: Callable[[Vector, Vector], Sequence[sp.Expr]] = lambda q, k: q

    @property
    def prefix(self) -> str:
        """Return what the names of the kernels begin with."""
        return self.name.lower()

    @property
    def adjusted(self) -> tuple[str, ...]:
        """Return the names of the intrinsic parameters that are unknowns."""
        return tuple(name for name in self.parameters if name not in self.constants)

    @property
    def unknowns(self) -> dict[str, str]:
        """Return names and units of the update of a camera."""
        return {**self.frame.unknowns, **{name: self.parameters[name] for name in self.adjusted}}

    @property
    def corrects(self) -> bool:
        """Tell whether measured points are corrected before they are compared."""
        return self._corrected(MEASURED.entries()) != MEASURED.entries()

    @property
    def camera_size(self) -> int:
        """Return the length of a stored camera."""
        return 12 + len(self.parameters)

    @property
    def tangent_size(self) -> int:
        """Return the length of an update of a camera."""
        return len(self.unknowns)

    @property
    def point_size(self) -> int:
        """Return the length of a point."""
        return self.frame.point_size

    def inputs(self) -> tuple[Input, Input]:
        """Return camera and point."""
        names = (*self.frame.entries, *self.parameters)
        return Input("camera", (len(names),), names=names), Input("X", (self.point_size,))

    def intrinsics(self) -> Input:
        """Return the parameters as an argument of their own."""
        return Input("intrinsics", (len(self.parameters),), names=tuple(self.parameters))

    def matrix(self) -> sp.Matrix:
        """Return M."""
        return sp.Matrix(3, 4, self.inputs()[0].entries()[:12])

    def point(self) -> sp.Matrix:
        """Return the point as a vector of four entries."""
        return sp.Matrix([*self.inputs()[1].entries(), sp.S.One][:4])

    def kernels(self) -> list[Kernel]:
        """Return projection, residual, Jacobians, update and gauge generators."""
        return [
            self._project(),
            self._residual(),
            self.observe(),
            self._sight(),
            self._retract(),
            self._image_alone(),
            *([self._correction()] if self.corrects else []),
            *generator_kernels(self),
        ]

    def _project(self) -> Kernel:
        stages, image, _ = self._measured()
        return Kernel(
            f"{self.prefix}_project",
            f"image of a point by the camera {self.name}: {self.title}; depth > 0 is in front.",
            self.inputs(),
            (
                Output.of("q_hat", sp.Matrix(image)),
                Output.of("depth", self.depth(sp.Matrix(H.entries()))),
            ),
            (*self._seen(), *stages),
        )

    def _residual(self) -> Kernel:
        return Kernel(
            f"{self.prefix}_residual",
            f"{self._rest()} of a point in the camera {self.name}.",
            (*self.inputs(), MEASURED),
            (self._difference(),),
            self._seen(),
        )

    def observe(self) -> Kernel:
        """Return the residual with its Jacobians."""
        slopes, a, b = self._slopes()
        turned = a * self.frame.velocities(sp.Matrix(H.entries()), self.point())
        return Kernel(
            f"{self.prefix}_observe",
            f"{self._rest()} of a point in the camera {self.name}, and the Jacobians of "
            f"{self._seen_as()} by the update of the camera ({', '.join(self.unknowns)}) and by "
            "the point.",
            (*self.inputs(), MEASURED),
            (
                self._difference(),
                Output.of("J_camera", turned.row_join(b)),
                Output.of("J_point", a * self.matrix()[:, : self.point_size]),
            ),
            (*self._seen(), slopes),
        )

    def _sight(self) -> Kernel:
        slopes, a, _ = self._slopes()
        return Kernel(
            f"{self.prefix}_sight",
            f"{self._rest()} of a point in the camera {self.name}, and the Jacobian of "
            f"{self._seen_as()} by the point.",
            (*self.inputs(), MEASURED),
            (self._difference(), Output.of("J_point", a * self.matrix()[:, : self.point_size])),
            (*self._seen(), slopes),
        )

    def _image_alone(self) -> Kernel:
        through, _ = self._image()
        slopes, a, _ = self._slopes()
        stages, image, turn = self._measured()
        return Kernel(
            f"{self.prefix}_image",
            f"image of h in the frame of the camera {self.name}, and its derivative a.",
            (H, self.intrinsics()) if self.parameters else (H,),
            (Output.of("q_hat", sp.Matrix(image)), Output.of("a", turn * a)),
            (through, *stages, slopes),
        )

    def _correction(self) -> Kernel:
        q = MEASURED.entries()
        corrected = self._corrected(q)
        return Kernel(
            f"{self.prefix}_correct",
            f"what the camera {self.name} compares with the image, c(q), and its derivative by q.",
            (MEASURED, self.intrinsics()),
            (
                Output.of("corrected", sp.Matrix(corrected)),
                Output.of("slope", jacobian(corrected, q)),
            ),
        )

    def _corrected(self, q: Vector) -> list[sp.Expr]:
        return [sp.sympify(e) for e in self.correct(q, self.intrinsics().entries())]

    def _rest(self) -> str:
        return "r = c(q) - q_hat, c the corrected point," if self.corrects else "r = q - q_hat"

    def _seen_as(self) -> str:
        return "-r" if self.corrects else "the image"

    def _measured(self) -> tuple[tuple[Let | Loop, ...], list[sp.Expr], sp.Matrix]:
        """Return the point that would be measured: stages, point, derivative by the image."""
        image = self._image()[1]
        if not self.corrects:
            return (), image, sp.eye(2)
        ideal, missed = (sp.symbols(f"{name}0:2", real=True) for name in ("ideal", "missed"))
        corrected = self._corrected(_FOUND)
        slope = sp.Matrix(2, 2, sp.symbols("slope0:2(0:2)", real=True))
        turn = slope.adjugate() / slope.det()
        named = dict(zip(slope, jacobian(corrected, _FOUND), strict=True))
        misses = [c - p for c, p in zip(corrected, ideal, strict=True)]
        steps = turn * sp.Matrix(missed)
        newton = Loop(
            start=dict(zip(_FOUND, ideal, strict=True)),
            body={**named, **dict(zip(missed, misses, strict=True))},
            update={x: x - step for x, step in zip(_FOUND, steps, strict=True)},
            passes=_NEWTON,
        )
        return (Let(dict(zip(ideal, image, strict=True))), newton, Let(named)), list(_FOUND), turn

    def _seen(self) -> tuple[Let, ...]:
        """Return the stages that name the point in the camera frame."""
        return (
            Let(dict(zip(H.entries(), self.matrix() * self.point(), strict=True))),
            self._image()[0],
        )

    def _difference(self) -> Output:
        measured = self._corrected(MEASURED.entries())
        r = [q - p for q, p in zip(measured, self._image()[1], strict=True)]
        return Output.of("r", sp.Matrix(self.wrap(r, self.intrinsics().entries())))

    def _image(self) -> tuple[Let, list[sp.Expr]]:
        """Return the image, by u and v where it depends on these only, and what names them."""
        h, k = sp.Matrix(H.entries()), self.intrinsics().entries()
        image = [sp.sympify(entry) for entry in self.image(h, k)]
        through = _by_direction(image)
        if any(entry.has(_INVERSE_DEPTH) for entry in through):
            return Let({}), image
        names = {_INVERSE_DEPTH: 1 / h[2], _U: h[0] * _INVERSE_DEPTH, _V: h[1] * _INVERSE_DEPTH}
        return Let(names), through

    def _slopes(self) -> tuple[Let, sp.Matrix, sp.Matrix]:
        """Return the derivatives of -r by h and by the adjusted parameters, by name."""
        intrinsics = dict(zip(self.parameters, self.intrinsics().entries(), strict=True))
        through, image = self._image()
        names: dict[sp.Symbol, sp.Expr] = {}

        def named(name: str, matrix: sp.Matrix) -> sp.Matrix:
            symbols = sp.Matrix(*matrix.shape, lambda i, j: sp.Symbol(f"{name}{i}{j}", real=True))
            matrix = sp.Matrix(*matrix.shape, list(matrix))
            for position, entry in enumerate(matrix):
                if not entry.is_Atom:
                    names[symbols[position]], matrix[position] = entry, symbols[position]
            return matrix

        if through.values:
            direction = sp.Matrix([[1, 0, -_U], [0, 1, -_V]]) * _INVERSE_DEPTH
            a = named("a", named("b", jacobian(image, [_U, _V])) * direction)
        else:
            a = named("a", jacobian(image, H.entries()))
        adjusted = [intrinsics[name] for name in self.adjusted]
        b = jacobian(image, adjusted) - jacobian(self._corrected(MEASURED.entries()), adjusted)
        return Let(names), a, b if b.cols else sp.zeros(2, 0)

    def _retract(self) -> Kernel:
        camera, _ = self.inputs()
        delta = Input("delta", (len(self.unknowns),))
        entries = dict(zip(self.unknowns, delta.entries(), strict=True))
        own = list(entries.values())[: len(self.frame.unknowns)]
        even = {symbol: formula for symbol, (formula, _) in self.frame.even(own).items()}
        k = dict(zip(self.parameters, camera.entries()[12:], strict=True))
        moved = [*self.frame.moved(self.matrix(), own)]
        moved += [k[name] + entries.get(name, 0) for name in k]
        return Kernel(
            f"{self.prefix}_retract",
            f"{self.name} camera moved by an update ({', '.join(self.unknowns)}).",
            (camera, delta),
            (Output.of("moved", sp.Matrix(moved)),),
            (Let(even),) if even else (),
        )


def _by_direction(expressions: Sequence[sp.Expr]) -> list[sp.Expr]:
    """Write expressions by u, v and 1/h2, so that there is one division."""
    h = H.entries()
    depths = {h[0]: _U / _INVERSE_DEPTH, h[1]: _V / _INVERSE_DEPTH, h[2]: 1 / _INVERSE_DEPTH}
    return [at(expression, depths) for expression in expressions]


@cache
def camera_models() -> tuple[CameraModel, ...]:
    """Return the camera model of every file of `models/cameras`, by name of the file."""
    from epigauge_derive.models import cameras

    found = []
    for name in sorted(module.name for module in pkgutil.iter_modules(cameras.__path__)):
        model = importlib.import_module(f"epigauge_derive.models.cameras.{name}").MODEL
        if model.prefix != name:
            raise ValueError(f"models/cameras/{name}.py: call the file {model.prefix}.py")
        if (*model.adjusted, *model.constants) != tuple(model.parameters):
            raise ValueError(f"models/cameras/{name}.py: the constants are the last parameters")
        found.append(model)
    return tuple(found)
