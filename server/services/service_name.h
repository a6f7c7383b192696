// The names of services, read from the descriptors of their messages: generated stubs would need
// gRPC's libraries.
#ifndef SERVER_SERVICES_SERVICE_NAME_H_
#define SERVER_SERVICES_SERVICE_NAME_H_

#include <string>

namespace spikeserve {

// Returns the full name, for example "spikeserve.v1.PolicyService", of the service that the .proto
// file of `Message` declares. REQUIRES: the file declares one service.
template <typename Message>
const std::string& ServiceName() {
  return Message::descriptor()->file()->service(0)->full_name();
}

}  // namespace spikeserve

#endif  // SERVER_SERVICES_SERVICE_NAME_H_
