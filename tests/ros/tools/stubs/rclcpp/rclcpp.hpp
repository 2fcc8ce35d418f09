// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0

// As much of rclcpp as examples/front_end.cpp uses, with the same signatures: where rclcpp is not installed, the
// example is still held against the real messages.

#pragma once

#include <builtin_interfaces/msg/time.hpp>
#include <cstddef>
#include <memory>
#include <string>

namespace rclcpp {

class QoS {
 public:
  QoS(std::size_t) {}  // implicit, as there: a depth is a profile
  QoS& transient_local() { return *this; }
};

template <typename Message>
class Publisher {
 public:
  using SharedPtr = std::shared_ptr<Publisher<Message>>;
  void publish(const Message&) {}
};

class Node {
 public:
  explicit Node(const std::string&) {}
  builtin_interfaces::msg::Time now() { return builtin_interfaces::msg::Time(); }  // there: a Time that converts to it

  template <typename Message>
  typename Publisher<Message>::SharedPtr create_publisher(const std::string&, const QoS&) {
    return std::make_shared<Publisher<Message>>();
  }
};

class WallRate {
 public:
  explicit WallRate(double) {}
  bool sleep() { return true; }
};

inline void init(int, char**) {}
inline bool ok() { return true; }
inline bool shutdown() { return true; }

}  // namespace rclcpp
