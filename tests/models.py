"""Small models in MJCF that tests share."""

import mujoco

PENDULUM = """
<mujoco>
  <option timestep="0.002" integrator="Euler"/>
  <worldbody><body name="pole" pos="0 0 1">
    <joint name="hinge" axis="0 1 0" damping="0.01"/>
    <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.6"
          contype="0" conaffinity="0"/>
  </body></worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-3 3" ctrllimited="true"/></actuator>
  <sensor><jointpos name="angle" joint="hinge"/></sensor>
</mujoco>
"""

ARM = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody><body name="upper" pos="0 0 1">
    <joint name="shoulder" axis="0 1 0" damping="0.05" limited="true" range="-170 170"/>
    <geom name="upper_arm" type="capsule" fromto="0 0 0 0.4 0 0" size="0.03" mass="1.2"
          contype="0" conaffinity="0"/>
    <body name="forearm" pos="0.4 0 0">
      <joint name="elbow" axis="0 1 0" damping="0.02" armature="0.01"/>
      <geom name="lower_arm" type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.7"
            contype="0" conaffinity="0"/>
    </body></body></worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="60" kv="2"/>
    <motor name="elbow" joint="elbow" gear="2"/>
  </actuator>
</mujoco>
"""

TUMBLER = """
<mujoco>
  <option timestep="0.002" iterations="50" ls_iterations="50"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1"/>
    <body name="box" pos="0 0 0.12"><freejoint name="free"/>
      <geom name="brick" type="box" size="0.1 0.05 0.03" mass="0.4"/>
      <body name="arm" pos="0.1 0 0"><joint name="ball" type="ball" damping="0.01"/>
        <geom name="stick" type="capsule" fromto="0 0 0 0.1 0 0" size="0.01" mass="0.1"
              contype="0" conaffinity="0"/></body></body>
  </worldbody>
</mujoco>
"""

SLIDER = """
<mujoco>
  <option timestep="0.002" iterations="50" ls_iterations="50"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1" friction="0.6"/>
    <body name="puck" pos="0 0 -0.2005">
      <joint name="up" type="slide" axis="0 0 1"/>
      <joint name="along" type="slide" axis="1 0 0"/>
      <geom name="ball" type="sphere" size="0.1" mass="0.5" friction="0.4" solref="0.03 1"/>
    </body></worldbody>
  <actuator><motor name="push" joint="along"/></actuator>
</mujoco>
"""

DRONE = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body name="frame" pos="0 0 1"><freejoint name="root"/>
    <geom name="hull" type="box" size="0.12 0.1 0.03" mass="0.8" contype="0" conaffinity="0"/>
    <site name="centre"/>
    <body name="load" pos="0 0 -0.05"><joint name="swing" type="ball" damping="0.002"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.2" size="0.01" mass="0.15"
            contype="0" conaffinity="0"/></body></body></worldbody>
  <actuator>
    <motor name="thrust" site="centre" gear="0 0 1 0 0 0" ctrlrange="0 20"/>
    <motor name="roll" site="centre" gear="0 0 0 1 0 0" ctrlrange="-1 1"/>
    <motor name="twist" joint="swing" gear="0 0 0.5"/>
  </actuator>
</mujoco>
"""

MUSCLE = """
<mujoco>
  <worldbody><body name="upper">
    <joint name="shoulder" axis="0 1 0"/><geom size="0.1" pos="0.2 0 0"/>
    <site name="origin" pos="0.1 0 0"/>
    <body name="forearm" pos="0.4 0 0">
      <joint name="elbow" axis="0 1 0"/><geom size="0.05" pos="0.2 0 0"/>
      <site name="insertion" pos="0.1 0 0.1"/>
    </body></body></worldbody>
  <tendon>
    <fixed name="cable" limited="true" range="-0.1 0.1" armature="0.1">
      <joint joint="shoulder" coef="1"/><joint joint="elbow" coef="-0.5"/></fixed>
    <spatial name="biceps"><site site="origin"/><site site="insertion"/></spatial>
  </tendon>
  <actuator><muscle tendon="biceps" lengthrange="0.1 1"/></actuator>
</mujoco>
"""


def showing(kind: str) -> str:
    """Return a model on which an effect of the catalogue shows."""
    return SLIDER if kind.startswith("contact_") else ARM


def spec(mjcf: str) -> mujoco.MjSpec:
    return mujoco.MjSpec.from_string(mjcf)
