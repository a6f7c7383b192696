// Files of tokens: every text is refused with a reason, or read.
#include "server/access/token_file.h"
#include "tests/fuzz/fuzz_target.h"

namespace spikeserve {

void FuzzOne(absl::string_view input) {
  const auto file = ParseTokenFile(input);
  if (!file.ok()) FUZZ_CHECK(!file.status().message().empty());
}

std::vector<std::string> Seeds() {
  const std::string hash(64, 'a');
  return {
      R"({"tenants": {"a": {"max_sessions": 2, "decisions_per_second": 5, "max_message_bytes": 9}},
    "tokens": [{"sha256": ")" +
          hash + R"(", "tenant": "a", "role": "agent", "learning": false,
    "expires": "2099-01-31T00:00:00Z"}]})",
      R"({"tenants": {"b": {}}, "tokens": [{"sha256": ")" + hash + R"(", "tenant": "b",
    "role": "operator", "sees": "all", "name": "alice"}]})"};
}

}  // namespace spikeserve
