# Puts gRPC's own libraries into the programs. Linked so, a thread-local variable of theirs costs an instruction instead
# of a call, of which every remote call makes hundreds. What gRPC itself needs stays shared.
foreach(library address_sorting gpr grpc grpc++ grpc++_reflection upb)
  find_library(SPIKESERVE_STATIC_${library} lib${library}.a REQUIRED)
  mark_as_advanced(SPIKESERVE_STATIC_${library})
  get_target_property(configuration gRPC::${library} IMPORTED_CONFIGURATIONS)
  set_target_properties(gRPC::${library} PROPERTIES
    IMPORTED_LOCATION_${configuration} ${SPIKESERVE_STATIC_${library}})
endforeach()
