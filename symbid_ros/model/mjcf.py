"""Read an MJCF, with MuJoCo as the parser."""

from collections import defaultdict
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.choices import Base
from symbid_ros.errors import ModelError
from symbid_ros.model.bodies import Body, BodyJoint, assemble
from symbid_ros.model.frames import AT_CENTER
from symbid_ros.model.inertia import phi_from_com
from symbid_ros.model.mjcf_source import Shapes, read_mjcf, reduced_mjcf
from symbid_ros.model.rotation import rotation_from_quaternion
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.xml_file import Element, as_element


def load_mjcf(path: Path, base: Base = "auto") -> RobotModel:
    """Load an MJCF: its only moving tree, with bodies as links and sites as frames.

    Where a branch of the tree ends in one ball that can touch something, such as a foot, its centre
    is a frame, too: it has the shape's name, or ``BODY_end`` if the shape has none or another
    frame has it. Of several balls it is the one whose centre a site marks.

    A joint follows another one, as URDF's mimic joints do, where an active ``<equality><joint>``
    with a linear ``polycoef`` says so: ``joint1`` follows ``joint2``, or the reverse if only
    ``joint1`` has a motor. Where both have one, the equality is ignored.

    The base floats if the root of the tree has a free joint, unless ``base`` is "fixed": it is then
    welded to the world where the file has it. Bodies welded to the world (a
    floor, a table) are not part of a floating robot, and free bodies without joints, such as a box
    that a robot may grasp, of no robot.

    Raises
    ------
    ModelError
        When :func:`symbid_ros.model.mjcf_source.read_mjcf` rejects the file or MuJoCo cannot
        compile it, or when it has a ball joint, a free joint below the root or more than one
        moving tree.
    """
    return _Reader(_compiled(path), str(path)).model(is_welded=base == "fixed")


def file_bodies(path: Path) -> tuple[dict[str, FloatArray], tuple[str, ...], RobotModel]:
    """Return φ (10,) of all bodies below the world by name, the robot's bodies, and the robot.

    Bodies are in file order, ``body_<number>`` is a body without a name. φ is about the body's own
    origin, as MuJoCo compiles it from the file.

    Raises
    ------
    ModelError
        See :func:`load_mjcf`.
    """
    reader = _Reader(_compiled(path), str(path))
    every = {reader.names[body]: reader.phi(body) for body in range(1, reader.m.nbody)}
    names = tuple(body.name for body in reader.bodies()[0])
    return every, names, reader.model(is_welded=False)


def compile_with_shapes(path: Path) -> Any:
    """Return MuJoCo's compiled model (``MjModel``) with the shapes of all bodies but the world.

    Raises
    ------
    ModelError
        See :func:`load_mjcf`; also when a mesh is missing or outside the model's folder.
    """
    return _compile(read_mjcf(path), path, "all")


def body_names(compiled: Any) -> list[str]:
    """Return the names of all bodies of a compiled model, the world first."""
    return [compiled.body(body).name or f"body_{body}" for body in range(compiled.nbody)]


def _compiled(path: Path) -> Any:
    root = read_mjcf(path)
    try:
        compiled = _compile(root, path, "simple")
    except ModelError:
        # A shape may take its mesh from a default class; the error, if any, is of what is needed.
        compiled = _compile(root, path, "none")
    names = [compiled.joint(joint).name for joint in range(compiled.njnt)]
    if any(not name for name, kind in zip(names, compiled.jnt_type, strict=True) if kind):
        joints = (one for part in root.iterfind("worldbody") for one in part.iter("joint"))
        unnamed = next(one for one in joints if not one.get("name") and one.get("type") != "free")
        raise ModelError(f"{as_element(unnamed).place}: a joint has no name; name it", "E105")
    return compiled


def _compile(root: Element, path: Path, shapes: Shapes) -> Any:
    # The core runs without MuJoCo, which only parses MJCF, so it is imported on first use.
    import mujoco  # noqa: PLC0415

    reduced = reduced_mjcf(root, path.parent, shapes)
    # Warnings concern simulation; MuJoCo would write them to the working directory.
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda warning: None)
    try:
        compiled = mujoco.MjModel.from_xml_string(reduced.text, reduced.meshes)
    except (ValueError, mujoco.FatalError) as error:
        reason = reduced.located(str(error))
        raise ModelError(f"{path}: MuJoCo cannot load the model: {reason}", "E113") from None
    finally:
        mujoco.set_mju_user_warning(handler)
    return compiled


class _Reader:
    """Reads a compiled MuJoCo model."""

    FREE, BALL, SLIDE, HINGE = range(4)
    SPHERE, CAPSULE = 2, 3  # types of shapes
    EQUAL_JOINTS = 2  # type of an equality

    def __init__(self, compiled: Any, source: str) -> None:
        self.m = compiled
        self.source = source

    @cached_property
    def names(self) -> list[str]:
        """Names of all bodies, the world first."""
        return body_names(self.m)

    def bodies(self) -> tuple[list[Body], int]:
        """Return the bodies of the moving tree, parents first, and MuJoCo's index of the root."""
        root, members = self._tree()
        index = {body: position for position, body in enumerate(members)}
        return [self._body(body, index, root) for body in members], root

    def model(self, *, is_welded: bool) -> RobotModel:
        bodies, root = self.bodies()
        floating = self.FREE in self._joint_kinds(root) and not is_welded
        gravity = np.array(self.m.opt.gravity)
        if not floating and root != 0:
            gravity = rotation_from_quaternion(self.m.body_quat[root]).T @ gravity
        name = self.m.names[: self.m.names.index(b"\0")].decode()
        return assemble(name, bodies, floating=floating, gravity=gravity, source=self.source)

    def _tree(self) -> tuple[int, list[int]]:
        """Return the root body of the moving tree and all its bodies in file order."""
        m = self.m
        roots = m.body_rootid[m.jnt_bodyid]
        moving = set(roots.tolist())
        if not moving:
            raise ModelError(f"{self.source}: no joint moves in this model; add joints", "E114")
        jointed = set(roots[m.jnt_type != self.FREE].tolist())
        objects = moving - jointed if jointed else set()
        moving -= objects
        root = moving.pop() if len(moving) == 1 else 0
        members = [body for body in range(m.nbody) if m.body_rootid[body] not in objects]
        if root == 0 or (m.body_jntnum[root] and self.FREE not in self._joint_kinds(root)):
            # A joint directly on the world: the world itself is the fixed base.
            if any(self.FREE in self._joint_kinds(body) for body in members):
                raise ModelError(
                    f"{self.source}: more than one moving tree; remove what is not the robot",
                    "E114",
                )
            return 0, members
        return root, [body for body in members if m.body_rootid[body] == root]

    def phi(self, body: int) -> FloatArray:
        """Return φ (10,) of a body about its own origin."""
        m = self.m
        inertia_axes = rotation_from_quaternion(m.body_iquat[body])
        central = inertia_axes @ np.diag(m.body_inertia[body]) @ inertia_axes.T
        return phi_from_com(float(m.body_mass[body]), np.array(m.body_ipos[body]), central)

    def _body(self, body: int, index: dict[int, int], root: int) -> Body:
        m = self.m
        at_root = body == root
        end, radius = self._ball(body)
        return Body(
            self.names[body],
            -1 if at_root else index[int(m.body_parentid[body])],
            rotation_from_quaternion(m.body_quat[body]),
            np.array(m.body_pos[body]),
            self.phi(body),
            () if at_root else tuple(self._joint(j) for j in self._joint_ids(body)),
            self._sites[body] | end,
            radius,
        )

    @cached_property
    def _sites(self) -> dict[int, dict[str, tuple[FloatArray, FloatArray]]]:
        """Named sites by body, with their poses.

        In MuJoCo a site and a body may share a name. A ``frame_id`` then means the body, and a
        site at another pose is called ``NAME:site``.
        """
        m = self.m
        sites: dict[int, dict[str, tuple[FloatArray, FloatArray]]] = defaultdict(dict)
        rotations = rotation_from_quaternion(np.array(m.site_quat))
        bodies = {m.body(body).name for body in range(m.nbody)}
        for site in range(m.nsite):
            body, name, position = int(m.site_bodyid[site]), m.site(site).name, m.site_pos[site]
            if not name:
                continue
            if name in bodies:
                if m.body(body).name == name and self._is_origin(rotations[site], position):
                    continue
                name = f"{name}:site"
            sites[body][name] = (rotations[site], np.array(position))
        return sites

    def _ball(self, body: int) -> tuple[dict[str, tuple[FloatArray, FloatArray]], dict[str, float]]:
        """Return the frame and the radius of the only ball of a body, if nothing moves beyond it.

        The ball can touch things. It may be the far end of a capsule. Of several balls it is the
        only one whose centre a site marks. A site with the name of the shape is its frame.
        """
        m = self.m
        touches = (m.geom_contype != 0) | (m.geom_conaffinity != 0)
        shapes = np.flatnonzero((m.geom_bodyid == body) & touches)
        kinds = m.geom_type[shapes]
        balls = shapes[kinds == (self.SPHERE if self.SPHERE in kinds else self.CAPSULE)].tolist()
        if len(balls) > 1:
            balls = [ball for ball in balls if self._marks(ball)]
        if body in self._carrying or len(balls) != 1:
            return {}, {}
        (ball,) = balls
        radius, name = float(m.geom_size[ball, 0]), m.geom(ball).name
        if name in self._marks(ball):
            return {}, {name: radius}
        names = name, f"{self.names[body]}_end"
        name = next((one for one in names if one and one not in self._frame_names), "")
        return ({name: (np.eye(3), self._center(ball))}, {name: radius}) if name else ({}, {})

    def _marks(self, ball: int) -> list[str]:
        """Return the sites at the centre of a ball."""
        center = self._center(ball)
        sites = self._sites[int(self.m.geom_bodyid[ball])].items()
        return [name for name, (_, at) in sites if np.linalg.norm(at - center) < AT_CENTER]

    def _center(self, ball: int) -> FloatArray:
        """Return the centre of a sphere, or that of the far end of a capsule."""
        m = self.m
        center = np.array(m.geom_pos[ball])
        if m.geom_type[ball] == self.CAPSULE:
            axis = rotation_from_quaternion(np.array(m.geom_quat[ball]))[:, 2]
            half = m.geom_size[ball, 1] * axis
            center = max(center + half, center - half, key=np.linalg.norm)
        return center

    @cached_property
    def _carrying(self) -> set[int]:
        """The world and all bodies beyond which a joint moves another one."""
        carrying = {0}
        for body in np.flatnonzero(self.m.body_jntnum).tolist():
            while (body := int(self.m.body_parentid[body])) not in carrying:
                carrying.add(body)
        return carrying

    @cached_property
    def _frame_names(self) -> set[str]:
        m = self.m
        return {*self.names, *(m.site(site).name for site in range(m.nsite))}

    @staticmethod
    def _is_origin(rotation: FloatArray, position: FloatArray) -> bool:
        return bool(np.allclose(rotation, np.eye(3), atol=1e-9) and np.allclose(position, 0.0))

    def _joint(self, joint: int) -> BodyJoint:
        m = self.m
        name = m.joint(joint).name
        kind = m.jnt_type[joint]
        if kind not in (self.SLIDE, self.HINGE):
            raise ModelError(
                f"{self.source}: joint {name!r} is a ball or inner free joint; use hinges", "E107"
            )
        moving: Literal["revolute", "prismatic"] = "revolute" if kind == self.HINGE else "prismatic"
        lower, upper = m.jnt_range[joint] if m.jnt_limited[joint] else (-np.inf, np.inf)
        return BodyJoint(
            name,
            moving,
            np.array(m.jnt_axis[joint]),
            # The position of a slide's axis has no effect, so the body's origin is used.
            np.array(m.jnt_pos[joint]) if moving == "revolute" else np.zeros(3),
            float(m.qpos0[m.jnt_qposadr[joint]]),
            float(lower),
            float(upper),
            float(self._efforts[joint]),
            float(m.dof_damping[m.jnt_dofadr[joint]]),
            float(m.dof_frictionloss[m.jnt_dofadr[joint]]),
            float(m.dof_armature[m.jnt_dofadr[joint]]),
            self._mimics.get(joint),
            stiffness=float(m.jnt_stiffness[joint]),
            spring_reference=float(m.qpos_spring[m.jnt_qposadr[joint]]),
        )

    @cached_property
    def _efforts(self) -> FloatArray:
        """(njnt,) maximum effort of each joint's motors; zero without a motor."""
        m = self.m
        efforts = np.zeros(m.njnt)
        for actuator in np.flatnonzero(m.actuator_trntype == 0):
            bounds = [np.inf]
            gear = abs(m.actuator_gear[actuator, 0])
            if m.actuator_ctrllimited[actuator]:
                bounds.append(np.abs(m.actuator_ctrlrange[actuator]).max() * gear)
            if m.actuator_forcelimited[actuator]:
                bounds.append(np.abs(m.actuator_forcerange[actuator]).max() * gear)
            efforts[m.actuator_trnid[actuator, 0]] += min(bounds)
        return efforts

    @cached_property
    def _mimics(self) -> dict[int, tuple[str, float, float]]:
        """Joints that follow another one: its name, the multiplier and the offset.

        MuJoCo measures both positions of an equality from their references:
        q1 - ref1 = a0 + a1 (q2 - ref2).
        """
        m = self.m
        leaders: dict[int, int] = {}
        mimics = {}
        linear = (m.eq_type == self.EQUAL_JOINTS) & (m.eq_obj2id >= 0) & (m.eq_active0 != 0)
        linear &= np.all(m.eq_data[:, 2:5] == 0.0, axis=1) & (m.eq_data[:, 1] != 0.0)
        pairs = np.stack([m.eq_obj1id, m.eq_obj2id], axis=1)
        # A joint with a motor leads, so what it moves is found first.
        driven = [bool(np.any(self._efforts[pair] > 0)) for pair in pairs * linear[:, None]]
        for equality in sorted(np.flatnonzero(linear), key=lambda one: not driven[one]):
            first, second = pairs[equality].tolist()
            shift, slope = m.eq_data[equality, :2].tolist()
            references = m.qpos0[m.jnt_qposadr[[first, second]]]
            offset = float(references[0] + shift - slope * references[1])
            for follower, leader, multiplier, constant in (
                (first, second, slope, offset),
                (second, first, 1.0 / slope, -offset / slope),
            ):
                end = leader
                while end in leaders:
                    end = leaders[end]
                if follower not in leaders and end != follower and not self._efforts[follower] > 0:
                    leaders[follower] = leader
                    mimics[follower] = m.joint(leader).name, multiplier, constant
                    break
        return mimics

    def _joint_ids(self, body: int) -> range:
        first = int(self.m.body_jntadr[body])
        return range(first, first + int(self.m.body_jntnum[body]))

    def _joint_kinds(self, body: int) -> list[int]:
        return [int(self.m.jnt_type[joint]) for joint in self._joint_ids(body)]
