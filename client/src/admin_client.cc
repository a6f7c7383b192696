#include "spikeserve/admin_client.h"

#include <utility>

#include "absl/memory/memory.h"
#include "google/protobuf/descriptor.h"
#include "google/protobuf/descriptor.pb.h"

namespace spikeserve {
namespace {

// Of a file in one message; short enough for every tenant's limit of a request.
constexpr size_t kPartBytes = 32 << 10;

}  // namespace

absl::StatusOr<std::unique_ptr<AdminClient>> AdminClient::Connect(const std::string& servers,
                                                                  ClientOptions options,
                                                                  absl::Duration patience) {
  auto client = Client::Connect(servers, std::move(options), patience);
  if (!client.ok()) return client.status();
  return absl::WrapUnique(new AdminClient(*std::move(client)));
}

absl::StatusOr<v1::PushPolicyResponse> AdminClient::Push(v1::PushPolicyRequest request,
                                                         const std::string& file) {
  v1::PushPolicyResponse response;
  const absl::Status status = client_->CallOther(
      kAdminTimeout, IsRepeatable(*v1::PushPolicyRequest::descriptor()),
      [&](const std::shared_ptr<grpc::Channel>& channel, grpc::ClientContext* context) {
        const auto stub = v1::PolicyAdmin::NewStub(channel);
        const auto writer = stub->PushPolicy(context, &response);
        // A write that fails ends the call, and Finish() says why.
        bool goes_on = writer->Write(request);
        for (size_t i = 0; goes_on && i < file.size(); i += kPartBytes) {
          v1::PushPolicyRequest part;
          part.add_data(file.substr(i, kPartBytes));
          goes_on = writer->Write(part);
        }
        if (goes_on) writer->WritesDone();
        return writer->Finish();
      });
  if (!status.ok()) return status;
  return response;
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
