// The methods that the server has, by path.
//
// Immutable after it was filled, and then thread-safe.
#ifndef SERVER_SERVICES_SERVICE_TABLE_H_
#define SERVER_SERVICES_SERVICE_TABLE_H_

#include <functional>
#include <memory>
#include <string>
#include <utility>

#include "absl/container/flat_hash_map.h"
#include "absl/strings/string_view.h"
#include "server/transport/call.h"

namespace spikeserve {

class LoopServices;

class ServiceTable {
 public:
  // Returns the handler of a new call on the loop that `services` belongs to.
  using Open = std::function<std::shared_ptr<CallHandler>(Call* call, LoopServices* services)>;

  // Adds the method at "/package.Service/Method".
  void Add(std::string path, Open open) { methods_.emplace(std::move(path), std::move(open)); }

  // Returns null if the server has no such method.
  const Open* Find(absl::string_view path) const {
    const auto found = methods_.find(path);
    return found == methods_.end() ? nullptr : &found->second;
  }

 private:
  absl::flat_hash_map<std::string, Open> methods_;
};

}  // namespace spikeserve

#endif  // SERVER_SERVICES_SERVICE_TABLE_H_
