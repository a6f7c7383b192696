#include "spikeserve/admin_client.h"

#include <utility>

#include "absl/memory/memory.h"
#include "google/protobuf/descriptor.h"
#include "google/protobuf/descriptor.pb.h"

namespace spikeserve {

absl::StatusOr<std::unique_ptr<AdminClient>> AdminClient::Connect(const std::string& servers,
                                                                  ClientOptions options,
                                                                  absl::Duration patience) {
  auto client = Client::Connect(servers, std::move(options), patience);
  if (!client.ok()) return client.status();
  return absl::WrapUnique(new AdminClient(*std::move(client)));
}

bool AdminClient::IsRepeatable(const google::protobuf::Descriptor& request) {
  const auto* service = request.file()->service(0);
  for (int i = 0; i < service->method_count(); ++i) {
    const auto* method = service->method(i);
    if (method->input_type() == &request) {
      return method->options().idempotency_level() !=
             google::protobuf::MethodOptions::IDEMPOTENCY_UNKNOWN;
    }
  }
  return false;
}

}  // namespace spikeserve
