// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0

// As much of rclcpp as the example of docs/front_end.md uses, with the same signatures: where rclcpp is not installed,
// the example is still held against the real messages.

#pragma once

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

  template <typename Message>
  typename Publisher<Message>::SharedPtr create_publisher(const std::string&, const QoS&) {
    return std::make_shared<Publisher<Message>>();
  }
};

}  // namespace rclcpp
