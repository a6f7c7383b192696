#include "server/services/reflection.h"

#include <google/protobuf/descriptor.h>
#include <google/protobuf/descriptor.pb.h>

#include <map>
#include <set>

#include "absl/strings/str_cat.h"
#include "absl/synchronization/mutex.h"
#include "server/services/call_gate.h"
#include "server/services/request_parser.h"

namespace spikeserve {
namespace {

namespace reflection = grpc::reflection::v1;
using google::protobuf::DescriptorPool;
using google::protobuf::FieldDescriptor;

void SetNotFound(const std::string& what, reflection::ServerReflectionResponse* response) {
  response->mutable_error_response()->set_error_code(static_cast<int>(absl::StatusCode::kNotFound));
  response->mutable_error_response()->set_error_message(absl::StrCat(what, ": not found"));
}

// Returns the description of a file, which is made once: it takes longer than a call on a loop may.
const std::string& Described(const google::protobuf::FileDescriptor& file) {
  static absl::Mutex mutex(absl::kConstInit);
  // By file; never destroyed. As many as the program has.
  static auto* const described =
      new std::map<const google::protobuf::FileDescriptor*, std::string>();
  absl::MutexLock lock(&mutex);
  std::string& bytes = (*described)[&file];
  if (bytes.empty()) {
    google::protobuf::FileDescriptorProto proto;
    file.CopyTo(&proto);
    bytes = proto.SerializeAsString();
  }
  return bytes;
}

// Adds the file and all files that it imports, each once.
void AddFiles(const google::protobuf::FileDescriptor& file,
              std::set<const google::protobuf::FileDescriptor*>* added,
              reflection::FileDescriptorResponse* response) {
  if (!added->insert(&file).second) return;
  response->add_file_descriptor_proto(Described(file));
  for (int i = 0; i < file.dependency_count(); ++i) AddFiles(*file.dependency(i), added, response);
}

void SetFile(const google::protobuf::FileDescriptor* file, const std::string& what,
             reflection::ServerReflectionResponse* response) {
  if (file == nullptr) return SetNotFound(what, response);
  std::set<const google::protobuf::FileDescriptor*> added;
  AddFiles(*file, &added, response->mutable_file_descriptor_response());
}

const google::protobuf::FileDescriptor* FileOfExtension(
    const reflection::ExtensionRequest& request) {
  const DescriptorPool& pool = *DescriptorPool::generated_pool();
  const auto* type = pool.FindMessageTypeByName(request.containing_type());
  if (type == nullptr) return nullptr;
  const auto* extension = pool.FindExtensionByNumber(type, request.extension_number());
  return extension == nullptr ? nullptr : extension->file();
}

void SetExtensionNumbers(const std::string& type_name,
                         reflection::ServerReflectionResponse* response) {
  const DescriptorPool& pool = *DescriptorPool::generated_pool();
  const auto* type = pool.FindMessageTypeByName(type_name);
  if (type == nullptr) return SetNotFound(type_name, response);
  auto* numbers = response->mutable_all_extension_numbers_response();
  numbers->set_base_type_name(type_name);
  std::vector<const FieldDescriptor*> extensions;
  pool.FindAllExtensions(type, &extensions);
  for (const FieldDescriptor* extension : extensions) {
    numbers->add_extension_number(extension->number());
  }
}

}  // namespace

void AnswerReflection(const reflection::ServerReflectionRequest& request,
                      const std::vector<std::string>& services,
                      reflection::ServerReflectionResponse* response) {
  response->Clear();
  response->set_valid_host(request.host());
  *response->mutable_original_request() = request;
  const DescriptorPool& pool = *DescriptorPool::generated_pool();
  switch (request.message_request_case()) {
    case reflection::ServerReflectionRequest::kFileByFilename:
      return SetFile(pool.FindFileByName(request.file_by_filename()), request.file_by_filename(),
                     response);
    case reflection::ServerReflectionRequest::kFileContainingSymbol:
      return SetFile(pool.FindFileContainingSymbol(request.file_containing_symbol()),
                     request.file_containing_symbol(), response);
    case reflection::ServerReflectionRequest::kFileContainingExtension:
      return SetFile(FileOfExtension(request.file_containing_extension()),
                     request.file_containing_extension().containing_type(), response);
    case reflection::ServerReflectionRequest::kAllExtensionNumbersOfType:
      return SetExtensionNumbers(request.all_extension_numbers_of_type(), response);
    case reflection::ServerReflectionRequest::kListServices:
      for (const std::string& name : services) {
        response->mutable_list_services_response()->add_service()->set_name(name);
      }
      return;
    case reflection::ServerReflectionRequest::MESSAGE_REQUEST_NOT_SET:
      response->mutable_error_response()->set_error_code(
          static_cast<int>(absl::StatusCode::kInvalidArgument));
      response->mutable_error_response()->set_error_message(
          "message_request: expected one of its fields, received none");
  }
}

void ReflectionCall::OnMessage(absl::string_view message) {
  reflection::ServerReflectionRequest request;
  if (auto status = ParseRequest(message, &request); !status.ok()) {
    return call_->Finish(status);
  }
  reflection::ServerReflectionResponse response;
  AnswerReflection(request, services_, &response);
  call_->Send(response);
}

void ReflectionCall::OnTooLong(size_t length) {
  call_->Finish(absl::ResourceExhaustedError(
      absl::StrCat("message: expected at most ", message_limit(), " bytes, received ", length)));
}

void ReflectionCall::OnHalfClose() { call_->Finish(absl::OkStatus()); }

void ReflectionCall::OnDrain() { call_->Finish(CallGate::DrainingError()); }

}  // namespace spikeserve
