// The functions that JavaScript calls (page/engine.js). They play one playground, and each returns
// JSON: what the function of Playground returns, or {"error": message}. A text is valid until the
// next call.
#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>

#include "client/playground/playground.h"

namespace {

std::unique_ptr<spikeserve::Playground> playground;

const char* Answer(const nlohmann::json& json) {
  static std::string text;
  text = json.dump(-1, ' ', false, nlohmann::json::error_handler_t::replace);
  return text.c_str();
}

const char* Answer(const absl::StatusOr<nlohmann::json>& json) {
  if (json.ok()) return Answer(*json);
  return Answer(nlohmann::json{{"error", std::string(json.status().message())}});
}

}  // namespace

extern "C" {

// Opens the policy file of `size` bytes. Keeps the playground before it if that fails.
const char* playground_open(const char* policy_file, size_t size, uint32_t seed) {
  auto opened = spikeserve::Playground::Open({policy_file, size}, seed);
  if (!opened.ok()) return Answer(absl::StatusOr<nlohmann::json>(opened.status()));
  playground = *std::move(opened);
  return Answer(nlohmann::json::object());
}

// REQUIRE: a playground is open.
const char* playground_step() { return Answer(playground->Step()); }
const char* playground_explain() { return Answer(playground->Explain()); }

}  // extern "C"
