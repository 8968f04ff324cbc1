"""package.xml, setup.py and the launch file name the same things as the code."""

import ast
import re
import xml.etree.ElementTree as ElementTree

from places import ROOT

import backlash_ros

ROS_PREFIXES = ('rclpy', 'ament_')
ROS_SUFFIXES = ('_msgs', '_srvs', '_interfaces')


def test_launch_file_names_executables_that_are_installed() -> None:
    tree = ast.parse((ROOT / 'launch' / 'backlash.launch.py').read_text())
    launched = {
        ast.literal_eval(call.args[0]) for call in ast.walk(tree)
        if isinstance(call, ast.Call) and ast.unparse(call.func) == 'node'
    }
    assert launched == {'controller', 'reference', 'recorder', 'plant'}


def test_package_xml_names_every_imported_ros_package() -> None:
    tree = ElementTree.parse(ROOT / 'package.xml')
    declared = {element.text for element in tree.iter('exec_depend')}
    imported = {
        module
        for path in ROOT.glob('backlash_ros/**/*.py')
        for module in re.findall(r'^ *(?:from|import) (\w+)', path.read_text(), re.MULTILINE)
    }
    ros = {
        name for name in imported
        if name.startswith(ROS_PREFIXES) or name.endswith(ROS_SUFFIXES)
    }
    assert 'rclpy' in ros
    assert ros <= declared


def test_package_xml_setup_and_module_name_one_version() -> None:
    package_xml = ElementTree.parse(ROOT / 'package.xml').findtext('version')
    tree = ast.parse((ROOT / 'setup.py').read_text())
    (setup,) = (
        ast.literal_eval(node.value) for node in ast.walk(tree)
        if isinstance(node, ast.keyword) and node.arg == 'version'
    )
    assert package_xml == setup == backlash_ros.__version__
