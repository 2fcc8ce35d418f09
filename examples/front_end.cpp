// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0

// Feed the node from a front-end in C++: a camera passes a grid of points, ten keyframes a second. In a package of
// yours:
//
//   find_package(rclcpp REQUIRED)
//   find_package(ba_msgs REQUIRED)
//   add_executable(front_end front_end.cpp)
//   target_link_libraries(front_end rclcpp::rclcpp ${ba_msgs_TARGETS})

#include <array>
#include <ba_msgs/msg/feature_tracks.hpp>
#include <ba_msgs/msg/keyframe.hpp>
#include <rclcpp/rclcpp.hpp>
#include <sensor_msgs/msg/camera_info.hpp>

class FrontEnd : public rclcpp::Node {
 public:
  explicit FrontEnd(const std::array<double, 9>& k) : Node("my_front_end") {
    cameras_ = create_publisher<sensor_msgs::msg::CameraInfo>("camera_info", rclcpp::QoS(1).transient_local());
    keyframes_ = create_publisher<ba_msgs::msg::Keyframe>("keyframes", 100);
    tracks_ = create_publisher<ba_msgs::msg::FeatureTracks>("feature_tracks", 100);
    sensor_msgs::msg::CameraInfo camera;
    camera.distortion_model = "plumb_bob";
    camera.d.assign(5, 0.0);
    camera.k = k;
    cameras_->publish(camera);
  }

  // Both with the same session_id and keyframe_id; keyframe.header.frame_id names the fixed frame.
  void send(const ba_msgs::msg::Keyframe& keyframe, const ba_msgs::msg::FeatureTracks& tracks) {
    keyframes_->publish(keyframe);
    tracks_->publish(tracks);
  }

 private:
  rclcpp::Publisher<sensor_msgs::msg::CameraInfo>::SharedPtr cameras_;
  rclcpp::Publisher<ba_msgs::msg::Keyframe>::SharedPtr keyframes_;
  rclcpp::Publisher<ba_msgs::msg::FeatureTracks>::SharedPtr tracks_;
};

int main(int argc, char** argv) {
  constexpr double focal = 400.0, cx = 320.0, cy = 240.0;
  rclcpp::init(argc, argv);
  FrontEnd front_end({focal, 0.0, cx, 0.0, focal, cy, 0.0, 0.0, 1.0});
  rclcpp::WallRate rate(10.0);
  for (int number = 0; rclcpp::ok() && number < 50; ++number) {
    const double x = 0.2 * number;  // looking along z, and moving sideways
    ba_msgs::msg::Keyframe keyframe;
    keyframe.header.stamp = front_end.now();
    keyframe.header.frame_id = "odom";
    keyframe.session_id = 1;
    keyframe.keyframe_id = number;
    keyframe.pose.pose.position.x = x;
    keyframe.pose.pose.orientation.w = 1.0;
    ba_msgs::msg::FeatureTracks tracks;
    tracks.header = keyframe.header;
    tracks.header.frame_id = "camera";
    tracks.session_id = keyframe.session_id;
    tracks.keyframe_id = keyframe.keyframe_id;
    for (int i = 0; i < 1000; ++i) {
      const double depth = 4.0 + i % 7, u = focal * (0.5 * (i / 20) - x) / depth + cx;
      const double v = focal * (0.4 * (i % 20) - 4.0) / depth + cy;
      if (u > 0.0 && u < 2.0 * cx && v > 0.0 && v < 2.0 * cy) {
        tracks.track_id.push_back(i);
        tracks.u.push_back(static_cast<float>(u));
        tracks.v.push_back(static_cast<float>(v));
      }
    }
    front_end.send(keyframe, tracks);
    rate.sleep();
  }
  rclcpp::shutdown();
}
