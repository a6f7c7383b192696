# Links gRPC's own libraries statically. In a static library an access to a thread-local variable costs an instruction
# instead of a function call, and every RPC makes hundreds of them. The libraries that gRPC uses stay shared.
foreach(library address_sorting gpr grpc grpc++ upb)
  find_library(SPIKESERVE_STATIC_${library} lib${library}.a REQUIRED)
  mark_as_advanced(SPIKESERVE_STATIC_${library})
  get_target_property(configuration gRPC::${library} IMPORTED_CONFIGURATIONS)
  set_target_properties(gRPC::${library} PROPERTIES
    IMPORTED_LOCATION_${configuration} ${SPIKESERVE_STATIC_${library}})
endforeach()

# Cross-built trees have the plugin of the other architecture. The build runs this machine's.
if(CMAKE_CROSSCOMPILING)
  find_program(SPIKESERVE_GRPC_PLUGIN grpc_cpp_plugin REQUIRED)
  mark_as_advanced(SPIKESERVE_GRPC_PLUGIN)
  get_target_property(configuration gRPC::grpc_cpp_plugin IMPORTED_CONFIGURATIONS)
  set_target_properties(gRPC::grpc_cpp_plugin PROPERTIES IMPORTED_LOCATION_${configuration} ${SPIKESERVE_GRPC_PLUGIN})
endif()
