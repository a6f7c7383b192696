#include "core/cli/printable_output.h"

#include <iostream>
#include <streambuf>
#include <string>

#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "core/base/printable.h"

namespace spikeserve {

// Stands before the buffer of a stream.
class PrintableOutput::Filter : public std::streambuf {
 public:
  explicit Filter(std::ostream& stream) : stream_(stream), next_(stream.rdbuf(this)) {}
  ~Filter() override {
    Filter::sync();
    stream_.rdbuf(next_);
  }

 protected:
  int_type overflow(int_type character) override {
    if (traits_type::eq_int_type(character, traits_type::eof())) return 0;
    const char byte = traits_type::to_char_type(character);
    return Write({&byte, 1}) ? character : traits_type::eof();
  }

  std::streamsize xsputn(const char* bytes, std::streamsize count) override {
    return Write({bytes, static_cast<size_t>(count)}) ? count : 0;
  }

  int sync() override {
    std::string text;
    AppendEscaped(begun_, &text);
    begun_.clear();
    return Pass(text) ? next_->pubsync() : -1;
  }

 private:
  bool Write(absl::string_view bytes) {
    const std::string all = begun_ + std::string(bytes);
    begun_.clear();
    std::string text;
    for (absl::string_view rest = all; !rest.empty();) {
      const Character character = FirstCharacter(rest);
      if (character.bytes == 0) {  // the rest of the character follows
        begun_ = std::string(rest);
        break;
      }
      const absl::string_view first = rest.substr(0, character.bytes);
      const bool shown = character.printable || first == "\n" || first == "\t";
      if (shown) {
        absl::StrAppend(&text, first);
      } else {
        AppendEscaped(first, &text);
      }
      rest.remove_prefix(character.bytes);
    }
    return Pass(text);
  }

  bool Pass(absl::string_view text) {
    const auto size = static_cast<std::streamsize>(text.size());
    return next_->sputn(text.data(), size) == size;
  }

  std::ostream& stream_;
  std::streambuf* const next_;
  std::string begun_;  // the beginning of a character
};

PrintableOutput::PrintableOutput()
    : out_(std::make_unique<Filter>(std::cout)), error_(std::make_unique<Filter>(std::cerr)) {}

PrintableOutput::~PrintableOutput() = default;

}  // namespace spikeserve
