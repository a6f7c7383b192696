# Texts that a program generates from its own flags, in the build folder below share/ where an installation has them.
#
# spikeserve_program_texts(PROGRAM): makes the manual page and the completion scripts of PROGRAM with every build. The
# target spikeserve_manuals makes those of all programs; its property SPIKESERVE_TEXTS lists the files.
add_custom_target(spikeserve_manuals ALL)

function(spikeserve_program_texts program)
  set(texts)
  foreach(kind_and_path
      man=share/man/man1/${program}.1
      bash=share/bash-completion/completions/${program}
      zsh=share/zsh/site-functions/_${program}
      fish=share/fish/vendor_completions.d/${program}.fish)
    string(REPLACE "=" ";" kind_and_path ${kind_and_path})
    list(GET kind_and_path 0 kind)
    list(GET kind_and_path 1 path)
    set(text ${CMAKE_BINARY_DIR}/${path})
    get_filename_component(folder ${text} DIRECTORY)
    file(MAKE_DIRECTORY ${folder})
    add_custom_command(OUTPUT ${text} COMMAND ${program} --generate=${kind} > ${text} DEPENDS ${program} VERBATIM)
    list(APPEND texts ${text})
  endforeach()
  add_custom_target(${program}_manual DEPENDS ${texts})
  add_dependencies(spikeserve_manuals ${program}_manual)
  set_property(TARGET spikeserve_manuals APPEND PROPERTY SPIKESERVE_TEXTS ${texts})
endfunction()
