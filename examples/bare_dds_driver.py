"""A driver without ROS: Eclipse Cyclone DDS from PyPI, and the paper's example as the plant.

    G(z) = (1e-5 z^2 + 4e-5 z + 1e-5) / (z^3 - 2.88504 z^2 + 2.77196 z - 0.88692), T = 0.01 s
    behind a backlash with m = 1.3, c_r = 3, c_l = -3

ROS 2 calls the DDS topic of /plant_output rt/plant_output, and std_msgs/msg/Float64 in DDS
std_msgs::msg::dds_::Float64_. Start it as docs/driver.md says.
"""

import math
import os
import signal
import time
from dataclasses import dataclass
from threading import Event

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

# Confined to this machine, as ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST confines the nodes. For
# several machines set CYCLONEDDS_URI to the network interface in use.
LOCALHOST = """<CycloneDDS><Domain>
  <General>
    <Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>
    <AllowMulticast>false</AllowMulticast>
  </General>
  <Discovery>
    <ParticipantIndex>auto</ParticipantIndex>
    <MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
    <Peers><Peer address="localhost"/></Peers>
  </Discovery>
</Domain></CycloneDDS>"""

SAMPLE_PERIOD_S = 0.01
EARLY = 0.1  # of a period
RELIABLE = Qos(
    Policy.Reliability.Reliable(max_blocking_time=100_000_000), Policy.Durability.Volatile,
    Policy.History.KeepLast(100),
)


@dataclass
class Float64(IdlStruct, typename='std_msgs::msg::dds_::Float64_'):
    """std_msgs/msg/Float64 as DDS knows it."""

    data: float64


class Plant:
    """Backlash, then G(z)."""

    def __init__(self) -> None:
        self._u = 0.0
        self._x = [0.0, 0.0, 0.0]

    def step(self, v: float) -> None:
        """Apply v over one sample period."""
        self._u = min(max(self._u, 1.3 * (v - 3.0)), 1.3 * (v + 3.0))
        y, x2, x3 = self._x
        self._x = [
            2.88504 * y + x2 + 1e-5 * self._u,
            -2.77196 * y + x3 + 4e-5 * self._u,
            0.88692 * y + 1e-5 * self._u,
        ]

    def measure(self) -> float:
        """y(k)."""
        return self._x[0]


def main() -> None:
    """Publish y(k) every sample period until SIGINT or SIGTERM."""
    stopping = Event()  # an exception could be raised in the middle of reading a message
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopping.set())
    os.environ.setdefault('CYCLONEDDS_URI', LOCALHOST)  # read with the first participant
    participant = DomainParticipant(int(os.environ.get('ROS_DOMAIN_ID', '0')))
    control = DataReader(participant, Topic(participant, 'rt/control', Float64), qos=RELIABLE)
    output = DataWriter(
        participant, Topic(participant, 'rt/plant_output', Float64), qos=RELIABLE
    )
    report = DataWriter(
        participant, Topic(participant, 'rt/applied_control', Float64), qos=RELIABLE
    )
    plant, v, sample = Plant(), 0.0, 0
    begin = time.monotonic()
    while not stopping.is_set():
        time.sleep(max(begin + sample * SAMPLE_PERIOD_S - time.monotonic(), 0.0))
        for message in control.take(10):
            # What is not a sample tells that a publisher has come or gone.
            if isinstance(message, Float64) and math.isfinite(message.data):
                v = message.data
        now = int((time.monotonic() - begin) / SAMPLE_PERIOD_S + EARLY)
        for _ in range(sample, now + 1):
            if sample:
                plant.step(v)
                report.write(Float64(v))
            sample += 1
        output.write(Float64(plant.measure()))


if __name__ == '__main__':
    main()
