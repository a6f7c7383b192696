# Generates the manual pages and completion scripts of programs, and installs them. The build writes them below share/ in
# the build folder, in the same folders as an installation.
#
# The target spikeserve_manuals generates the texts of all programs.
add_custom_target(spikeserve_manuals ALL)

# spikeserve_program_texts(PROGRAM): generates the manual page, plain and compressed, and the completion scripts of
# PROGRAM for bash, zsh and fish with every build.
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
  # -n leaves out the time, so that builds are reproducible.
  set(page ${CMAKE_BINARY_DIR}/share/man/man1/${program}.1)
  add_custom_command(OUTPUT ${page}.gz COMMAND gzip -9nc ${page} > ${page}.gz DEPENDS ${page} VERBATIM)
  add_custom_target(${program}_manual DEPENDS ${texts} ${page}.gz)
  add_dependencies(spikeserve_manuals ${program}_manual)
endfunction()

# spikeserve_install_texts(COMPONENT PROGRAM...): installs the texts of the programs with a component. Debian's zsh reads
# the completions of packages from vendor-completions, and those below other prefixes from site-functions.
function(spikeserve_install_texts component)
  foreach(program ${ARGN})
    set(share ${CMAKE_BINARY_DIR}/share)
    install(FILES ${share}/man/man1/${program}.1.gz DESTINATION ${CMAKE_INSTALL_MANDIR}/man1 COMPONENT ${component})
    install(FILES ${share}/bash-completion/completions/${program}
      DESTINATION ${CMAKE_INSTALL_DATADIR}/bash-completion/completions COMPONENT ${component})
    install(FILES ${share}/fish/vendor_completions.d/${program}.fish
      DESTINATION ${CMAKE_INSTALL_DATADIR}/fish/vendor_completions.d COMPONENT ${component})
    install(CODE "
      set(functions site-functions)
      if(CMAKE_INSTALL_PREFIX STREQUAL /usr)
        set(functions vendor-completions)
      endif()
      file(INSTALL ${share}/zsh/site-functions/_${program}
           DESTINATION \${CMAKE_INSTALL_PREFIX}/${CMAKE_INSTALL_DATADIR}/zsh/\${functions})"
      COMPONENT ${component})
  endforeach()
endfunction()
