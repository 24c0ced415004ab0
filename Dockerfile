# The nodes in ROS's own image:
#   docker build --target nodes -t starcal .
#   docker run --rm --network host --ipc host -v "$PWD/flight:/flight" starcal \
#       ros2 launch starcal starcal.launch.py params_file:=/flight/params.yaml
# The tests, in an environment from PyPI:
#   docker build --target tests -t starcal-tests . && docker run --rm starcal-tests
FROM ros:jazzy-ros-base AS nodes
ENV PIP_BREAK_SYSTEM_PACKAGES=1
WORKDIR /workspace
COPY . src/starcal
RUN apt-get update \
    && rosdep update \
    && rosdep install --from-paths src --ignore-src -y \
    && apt-get install -y --no-install-recommends python3-pip \
    && python3 -m pip install --no-cache-dir mcap==1.6.0 rosbags==0.11.9 threadpoolctl==3.8.0 \
    && . /opt/ros/jazzy/setup.sh \
    && colcon build --packages-select starcal --cmake-args -DBUILD_TESTING=OFF \
    && rm -rf build log /var/lib/apt/lists/*
RUN sed -i '$i source /workspace/install/setup.bash' /ros_entrypoint.sh
CMD ["ros2", "launch", "starcal", "starcal.launch.py"]

FROM python:3.12-bookworm AS tests
RUN apt-get update \
    && apt-get install -y --no-install-recommends cmake g++ make \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /starcal
COPY . .
RUN make setup
CMD ["make", "test"]
