"""Names of all topics, and labels of the array messages."""

REFERENCE = 'reference'
PLANT_OUTPUT = 'plant_output'
CONTROL = 'control'
APPLIED_CONTROL = 'applied_control'
# They replace plant_output and control with io.style: ros2_control.
JOINT_STATES = 'joint_states'
JOINT_COMMANDS = 'forward_command_controller/commands'
# These replace reference, plant_output and control with io.style: joint_state_topic.
ROBOT_COMMAND, ROBOT_STATES = 'robot_joint_command', 'robot_joint_states'
JOINT_STATE_COMMANDS = 'joint_commands'
APPLIED_JOINT_COMMANDS = 'applied_joint_commands'
ESTIMATES = 'controller/estimates'
SIGNALS = 'controller/signals'
MODEL = 'controller/model'
WATCH = 'controller/watch'
TRUTH = 'plant/truth'
CLOCK = '/clock'
DIAGNOSTICS = '/diagnostics'

BACKLASH = ('m', 'c_r', 'c_l')
# `sample` counts the plant outputs, lost or not, and joins rows of different topics. It begins with
# 0, or with the time in sample periods if the controller may have been restarted. std_f is always
# nan: f is given, or adapted by a law without standard deviations.
ESTIMATE_LABELS = ('m', 'c_r', 'c_l', 'f', 'std_m', 'std_c_r', 'std_c_l', 'std_f', 'sample')
# latency_s is the time from the sending of y(k) by the driver to that of v(k) by the controller.
SIGNAL_LABELS = ('y_m', 'y', 'u_d', 'v', 'u_hat', 'innovation', 'status', 'sample', 'latency_s')
# A topic for each below WATCH, for plots: estimates have a band of two standard deviations.
WATCH_LABELS = (
    'm', 'm_low', 'm_high', 'c_r', 'c_r_low', 'c_r_high', 'c_l', 'c_l_low', 'c_l_high', 'gap',
    *(label for label in SIGNAL_LABELS if label != 'sample'),
)
TRUTH_LABELS = ('u', 'm', 'c_r', 'c_l', 'v', 'sample')
# The labels of each array topic; numerator and denominator of MODEL have several numbers.
LABELS_OF = {
    SIGNALS: SIGNAL_LABELS, ESTIMATES: ESTIMATE_LABELS, TRUTH: TRUTH_LABELS,
    MODEL: ('numerator', 'denominator', 'delay_samples'),
}


def of_node(topic: str) -> str:
    """The private name ~/... under which a node publishes its topic."""
    return '~/' + topic.partition('/')[2]


def watched(label: str, joint: str = '') -> str:
    """The topic of one of WATCH_LABELS."""
    return f'{WATCH}/{joint}/{label}' if joint else f'{WATCH}/{label}'


def of_joint(label: str, joint: str) -> str:
    """The label of a quantity of a joint: the label itself for the only, nameless joint."""
    return f'{joint}.{label}' if joint else label
