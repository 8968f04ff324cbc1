"""The gear of the film as MuJoCo draws it: a motor with a fork, a load with a pin in it."""

from __future__ import annotations

from math import cos, degrees, pi, radians, sin

import mujoco
import numpy as np
from numpy.typing import NDArray

PIN, PIN_AT = 0.04, 0.47  # radius of the pin, and its distance from the axis
PRONG = 0.03  # half of its thickness
POINTER, DIAL = 0.86, 1.0  # from the axis
BACK = '.93 .94 .95 1'


class Scene:
    """Draws angles [rad], all of them as many times larger as magnified says."""

    def __init__(self, gap: float, magnified: float, width: int, height: int) -> None:
        self._magnified = magnified
        self._model = mujoco.MjModel.from_xml_string(
            _description(0.5 * gap * magnified, magnified, width, height)
        )
        self._data = mujoco.MjData(self._model)
        self._renderer = mujoco.Renderer(self._model, height, width)

    def draw(self, y_m: float, motor: float, load: float) -> NDArray[np.uint8]:
        """The picture, shape (height, width, 3)."""
        self._data.qpos[:] = self._magnified * np.array([y_m, motor, load])
        mujoco.mj_forward(self._model, self._data)
        self._renderer.update_scene(self._data, camera='front')
        return self._renderer.render()

    def close(self) -> None:
        """Give the renderer back."""
        self._renderer.close()


def _description(half_gap: float, magnified: float, width: int, height: int) -> str:
    # The pin touches a prong once the angle between motor and load is half of the gap.
    beside = PIN + PIN_AT * sin(half_gap) + PRONG
    return f"""
<mujoco>
  <visual>
    <global offwidth="{width}" offheight="{height}"/>
    <quality offsamples="8"/>
    <headlight ambient=".55 .55 .55" diffuse=".35 .35 .35" specular="0 0 0"/>
  </visual>
  <asset><texture type="skybox" builtin="flat" rgb1="1 1 1" rgb2="1 1 1" width="8" height="8"/>
  </asset>
  <worldbody>
    <light directional="true" pos="-1 -2 2" dir=".4 1 -.7" castshadow="false"
           diffuse=".25 .25 .25" specular="0 0 0"/>
    <camera name="front" pos="0 -9 .9" xyaxes="1 0 0 0 .082 1" fovy="11.6"/>
    <geom type="cylinder" size="1.02 .01" pos="0 .12 0" euler="90 0 0" rgba="{BACK}"/>
    {_ticks(magnified)}
    <body name="reference">
      <joint type="hinge" axis="0 1 0"/>
      <geom type="box" size=".007 .004 .49" pos="0 .07 .49" rgba=".1 .1 .1 1"/>
      <geom type="box" size=".035 .006 .05" pos="0 .05 {DIAL - 0.05}" rgba=".1 .1 .1 1"/>
    </body>
    <body name="motor">
      <joint type="hinge" axis="0 1 0"/>
      <geom type="cylinder" size=".19 .03" pos="0 -.1 0" euler="90 0 0" rgba=".9 .55 .1 1"/>
      <geom type="box" size="{beside + PRONG} .03 .05" pos="0 -.1 -.22" rgba=".9 .55 .1 1"/>
      <geom type="box" size="{PRONG} .03 .18" pos="{beside} -.1 -.42" rgba=".9 .55 .1 1"/>
      <geom type="box" size="{PRONG} .03 .18" pos="{-beside} -.1 -.42" rgba=".9 .55 .1 1"/>
    </body>
    <body name="load">
      <joint type="hinge" axis="0 1 0"/>
      <geom type="box" size=".03 .02 {0.5 * POINTER}" pos="0 0 {0.5 * POINTER}"
            rgba=".1 .4 .8 1"/>
      <geom type="cylinder" size=".11 .02" euler="90 0 0" rgba=".1 .4 .8 1"/>
      <geom type="box" size=".03 .02 {0.5 * PIN_AT}" pos="0 0 {-0.5 * PIN_AT}"
            rgba=".1 .4 .8 1"/>
      <geom type="cylinder" size="{PIN} .15" pos="0 0 {-PIN_AT}" euler="90 0 0"
            rgba=".1 .4 .8 1"/>
    </body>
  </worldbody>
</mujoco>"""


def _ticks(magnified: float) -> str:
    """One for each degree as it is."""
    step = radians(magnified)
    return '\n'.join(
        f'<geom type="box" size=".006 .004 .045" pos="{DIAL * sin(a)} .09 {DIAL * cos(a)}" '
        f'euler="0 {degrees(a)} 0" rgba=".45 .5 .55 1"/>'
        for a in (k * step for k in range(-round(0.5 * pi / step), round(0.5 * pi / step) + 1))
    )
