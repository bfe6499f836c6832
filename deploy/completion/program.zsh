#compdef PROGRAM
# zsh completion of PROGRAM: click knows the words, and what each is for.
_FUNCTION() {
  local -a lines described plain
  local kind word text
  lines=("${(@f)$(COMP_WORDS="${words[*]}" COMP_CWORD=$((CURRENT - 1)) \
    _VARIABLE_COMPLETE=zsh_complete ${words[1]} 2>/dev/null)}")
  for kind word text in "${lines[@]}"; do
    case $kind in
      plain) if [[ $text == _ ]]; then plain+=("$word"); else described+=("$word:$text"); fi ;;
      dir) _path_files -/ ;;
      file) _path_files -f ;;
    esac
  done
  (( ! $#described )) || _describe -V unsorted described -U
  (( ! $#plain )) || compadd -U -V unsorted -a plain
}
_FUNCTION "$@"
