// Appends CBOR (RFC 8949) to a string, item by item, without building a document in memory first.
//
//   CborWriter writer(&bytes);
//   writer.Array(2);
//   writer.Text("x");
//   writer.Float(1.5f);
//
// The caller opens arrays and maps with their number of items and then writes these items. Numbers
// are exact: floats keep their 32 bits and doubles their 64 bits. Not thread-safe.
#pragma once

#include <bit>
#include <cstddef>
#include <cstdint>
#include <string>

#include "absl/strings/string_view.h"

namespace spikeserve {

class CborWriter {
 public:
  // `out` must outlive the writer.
  explicit CborWriter(std::string* out) : out_(*out) {}

  void Array(size_t items) { Head(4, items); }
  void Map(size_t pairs) { Head(5, pairs); }
  void Text(absl::string_view text) {
    Head(3, text.size());
    out_.append(text.data(), text.size());
  }
  void Unsigned(uint64_t value) { Head(0, value); }
  void Signed(int64_t value) {
    // CBOR stores -1 - n for a negative number, which is its complement.
    value < 0 ? Head(1, ~static_cast<uint64_t>(value)) : Head(0, static_cast<uint64_t>(value));
  }
  void Float(float value) { BigEndian(0xfa, std::bit_cast<uint32_t>(value), 4); }
  void Double(double value) { BigEndian(0xfb, std::bit_cast<uint64_t>(value), 8); }
  void Bool(bool value) { out_.push_back(static_cast<char>(value ? 0xf5 : 0xf4)); }
  void Null() { out_.push_back(static_cast<char>(0xf6)); }

 private:
  // Writes the major type and its argument in the shortest form.
  void Head(int major, uint64_t argument) {
    const int first = major << 5;
    if (argument < 24) {
      out_.push_back(static_cast<char>(first + static_cast<int>(argument)));
    } else if (argument <= 0xff) {
      BigEndian(first + 24, argument, 1);
    } else if (argument <= 0xffff) {
      BigEndian(first + 25, argument, 2);
    } else if (argument <= 0xffffffff) {
      BigEndian(first + 26, argument, 4);
    } else {
      BigEndian(first + 27, argument, 8);
    }
  }

  void BigEndian(int first, uint64_t value, int bytes) {
    char item[9];
    item[0] = static_cast<char>(first);
    for (int i = 0; i < bytes; ++i) item[1 + i] = static_cast<char>(value >> (8 * (bytes - 1 - i)));
    out_.append(item, static_cast<size_t>(1 + bytes));
  }

  std::string& out_;
};

}  // namespace spikeserve
