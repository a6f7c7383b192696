// Escapes what a terminal would obey, in everything that a program writes to std::cout and
// std::cerr. Peers choose names, labels and error texts, which a program prints.
#pragma once

#include <memory>

namespace spikeserve {

// Lives as long as the program. Line feeds and tabs stay. Not thread-safe, like the streams.
//
//   const PrintableOutput output;
//   std::cout << "\x1b]52;c;...";  // writes \u001b]52;c;...
class PrintableOutput {
 public:
  PrintableOutput();
  ~PrintableOutput();
  PrintableOutput(const PrintableOutput&) = delete;
  PrintableOutput& operator=(const PrintableOutput&) = delete;

 private:
  class Filter;
  std::unique_ptr<Filter> out_;
  std::unique_ptr<Filter> error_;
};

}  // namespace spikeserve
