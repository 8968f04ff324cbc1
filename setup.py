"""Build description read by colcon (ament_python) and by pip."""

from glob import glob

from setuptools import find_packages, setup

PACKAGE = 'backlash_ros'

setup(
    name=PACKAGE,
    version='0.2.0',
    description='Adaptive backlash inverse control: learns an unknown backlash and cancels it',
    author='backlash_ros developers',
    maintainer='backlash_ros developers',
    maintainer_email='maintainers@example.org',
    license='Apache-2.0',
    packages=find_packages(exclude=['test*']),
    package_data={
        f'{PACKAGE}.middleware': ['loopback.xml', 'network.xml'],
        f'{PACKAGE}.nodes': ['live.html'],
        f'{PACKAGE}.tools': ['page.html', 'comparison.md', 'figures.mplstyle'],
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        (f'share/{PACKAGE}', ['README.md']),
        (f'share/{PACKAGE}/config', sorted(glob('config/*'))),
        (f'share/{PACKAGE}/launch', sorted(glob('launch/*.launch.py'))),
        (f'share/{PACKAGE}/examples', sorted(glob('examples/*.py'))),
        *(
            (f'share/{PACKAGE}/{folder}', sorted(glob(f'{folder}/{pattern}')))
            for folder, pattern in (
                ('docs', '*.md'), ('docs/images', '*'), ('docs/reference', '*.md'),
                ('docs/results', '*.md'), ('docs/results/images', '*'),
            )
        ),
    ],
    zip_safe=False,
    python_requires='>=3.10',
    # rclpy is not listed: a ROS machine has it under another name than the package index.
    install_requires=[
        'matplotlib', 'mcap', 'numpy', 'PyYAML', 'rich', 'rosbags', 'scipy', 'tqdm',
    ],
    extras_require={
        'cluster': ['distributed'],
        'parquet': ['pyarrow'],
        'test': [
            'aiohttp', 'distributed', 'hypothesis', 'mcap-ros2-support', 'pyarrow', 'pytest',
            'pytest-timeout',
        ],
    },
    entry_points={
        'console_scripts': [
            f'controller = {PACKAGE}.nodes.controller:main',
            f'plant = {PACKAGE}.nodes.plant:main',
            f'reference = {PACKAGE}.nodes.reference:main',
            f'recorder = {PACKAGE}.nodes.recorder:main',
            f'bringup = {PACKAGE}.tools.bringup.__main__:main',
            f'simulate = {PACKAGE}.tools.simulate:main',
            f'report = {PACKAGE}.tools.report:main',
            f'compare = {PACKAGE}.tools.compare:main',
            f'check_driver = {PACKAGE}.nodes.check_driver:main',
            f'identify = {PACKAGE}.tools.identify.command:main',
            f'replay = {PACKAGE}.tools.replay:main',
            f'monitor = {PACKAGE}.nodes.monitor:main',
            f'live = {PACKAGE}.nodes.live:main',
        ],
    },
)
