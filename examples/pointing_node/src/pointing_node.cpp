// Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
//
// Answers pixels (geometry_msgs/PointStamped, x and y) with lines of sight in the star tracker
// frame (geometry_msgs/Vector3Stamped).  Parameter `table`: path of starcal_camera.bin; empty: the
// camera that was compiled in.  Setting it changes the calibration; a bad table is refused and the
// camera in use stays.

#include <exception>
#include <fstream>
#include <iostream>
#include <iterator>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include <geometry_msgs/msg/point_stamped.hpp>
#include <geometry_msgs/msg/vector3_stamped.hpp>
#include <rclcpp/rclcpp.hpp>

#include "starcal_camera.h"

namespace
{

// A camera and the table that it points into.
struct Calibrated
{
  std::vector<unsigned char> table;
  starcal_camera camera;
};

// Empty, or why there is no camera at the path.
std::string read_camera(const std::string & path, Calibrated & read)
{
  starcal_status status;
  if (path.empty()) {
    status = starcal_builtin(&read.camera);
  } else {
    std::ifstream file(path, std::ios::binary);
    if (!file) {
      return "cannot be read";
    }
    read.table.assign(std::istreambuf_iterator<char>(file), {});
    status = starcal_load(read.table.data(), read.table.size(), &read.camera);
  }
  if (status == STARCAL_OK) {
    status = starcal_self_test(&read.camera);
  }
  return status == STARCAL_OK ? "" : "refused with starcal_status " + std::to_string(status);
}

}  // namespace

class PointingNode : public rclcpp::Node
{
public:
  PointingNode()
  : Node("pointing_node"), frame_(declare_parameter("star_tracker_frame", "star_tracker"))
  {
    sights_ = create_publisher<geometry_msgs::msg::Vector3Stamped>("line_of_sight", 10);
    on_set_ = add_on_set_parameters_callback(
      [this](const std::vector<rclcpp::Parameter> & changed) {return use(changed);});
    declare_parameter("table", "");
    pixels_ = create_subscription<geometry_msgs::msg::PointStamped>(
      "pixel", 10, [this](const geometry_msgs::msg::PointStamped & pixel) {answer(pixel);});
  }

private:
  rcl_interfaces::msg::SetParametersResult use(const std::vector<rclcpp::Parameter> & changed)
  {
    rcl_interfaces::msg::SetParametersResult result;
    result.successful = true;
    for (const auto & parameter : changed) {
      if (parameter.get_name() != "table") {
        continue;
      }
      auto read = std::make_unique<Calibrated>();
      const std::string why = read_camera(parameter.as_string(), *read);
      if (!why.empty()) {
        result.successful = false;
        result.reason = "table " + parameter.as_string() + ": " + why;
        return result;
      }
      calibrated_ = std::move(read);
      RCLCPP_INFO(get_logger(), "camera of %ld ns", static_cast<long>(calibrated_->camera.time_ns));
    }
    return result;
  }

  void answer(const geometry_msgs::msg::PointStamped & asked)
  {
    const double pixel[2] = {asked.point.x, asked.point.y};
    double in_camera[3], in_star_tracker[3];
    const auto & camera = calibrated_->camera;
    starcal_status status = starcal_line_of_sight(&camera, pixel, in_camera, nullptr);
    if (status == STARCAL_OK) {
      status = starcal_to_star_tracker(&camera, in_camera, in_star_tracker);
    }
    if (status != STARCAL_OK) {
      RCLCPP_WARN(
        get_logger(), "pixel %g %g: starcal_status %d", pixel[0], pixel[1],
        static_cast<int>(status));
      return;
    }
    geometry_msgs::msg::Vector3Stamped sight;
    sight.header.stamp = asked.header.stamp;
    sight.header.frame_id = frame_;
    sight.vector.x = in_star_tracker[0];
    sight.vector.y = in_star_tracker[1];
    sight.vector.z = in_star_tracker[2];
    sights_->publish(sight);
  }

  std::string frame_;
  std::unique_ptr<Calibrated> calibrated_;
  rclcpp::Publisher<geometry_msgs::msg::Vector3Stamped>::SharedPtr sights_;
  rclcpp::Subscription<geometry_msgs::msg::PointStamped>::SharedPtr pixels_;
  rclcpp::node_interfaces::OnSetParametersCallbackHandle::SharedPtr on_set_;
};

int main(int argc, char ** argv)
{
  rclcpp::init(argc, argv);
  try {
    rclcpp::spin(std::make_shared<PointingNode>());
  } catch (const std::exception & error) {  // a bad table at the start
    std::cerr << "pointing_node: " << error.what() << std::endl;
    return 2;
  }
  rclcpp::shutdown();
  return 0;
}
